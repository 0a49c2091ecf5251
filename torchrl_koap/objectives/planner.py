# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner's training loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torchrl_koap import keys
from torchrl_koap.modules.diffusion.planner import StatePlanner


class PlannerLoss(LossModule):
    r"""Mean squared error of the denoiser at random noise levels.

    With the normalised future ``x_0``, noise ``eps ~ N(0, I)`` and a random time ``t`` per plan,

        L = mean | denoiser(signal(t) x_0 + noise(t) eps, t, condition) - target |^2

    where the schedule's prediction type says whether the target is the noise, the clean plan or the velocity.

    Args:
        planner (StatePlanner): planner to train, its normalisers already fitted.

    Keyword Args:
        window (bool): read whole windows ``[*B, history + horizon, d]`` from the entry ``state`` and cut them (True),
            or read the entries ``history`` and ``plan`` (False). Defaults to True.
        create_target_params (bool): keep an averaged copy of the weights in ``target_planner_params``, to be moved by
            :class:`torchrl.objectives.SoftUpdate` and used for planning. Defaults to True.
        reduction (str): ``"mean"`` | ``"sum"`` | ``"none"`` over the elements ``[*B, H, d]``. Defaults to ``"mean"``.
        first_steps_weight (float): weight of the first planned step against that of the last; it falls geometrically
            in between, and the mean weight is 1. Defaults to 1.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if an entry has another shape than the planner needs, or ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_koap.modules.diffusion.unet import TemporalUnet
        >>> from torchrl_koap.modules.diffusion.planner import StatePlanner
        >>> from torchrl_koap.objectives.planner import PlannerLoss
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> loss = PlannerLoss(planner)
        >>> average = SoftUpdate(loss, eps=0.99)
        >>> loss(TensorDict({"state": torch.randn(8, 16, 2)}, [8]))["loss_planner"].backward()
        >>> average.step()
        >>> with loss.target_planner_params.to_module(planner):
        ...     plan = planner(TensorDict({"history": torch.randn(3, 2, 2)}, [3]))["plan"]
    """

    @dataclass
    class _AcceptedKeys:
        """Entries of the input; the last three are read if they are there.

        Attributes:
            state (NestedKey): windows ``[*B, history + horizon, d]``. Defaults to ``"state"``.
            history (NestedKey): observed frames ``[*B, history, d]``. Defaults to the planner's in-key.
            plan (NestedKey): recorded future ``[*B, horizon, d]``. Defaults to the planner's out-key.
            mask (NestedKey): bool, False where a step is padding: ``[*B, horizon]`` or ``[*B, history + horizon]``,
                with or without a trailing 1. Defaults to ``"mask"``.
            noise (NestedKey): noise ``[*B, horizon, d]`` instead of random. Defaults to ``"planner_noise"``.
            time (NestedKey): time ``[*B]`` in training steps instead of random. Defaults to ``"planner_time"``.
        """

        state: NestedKey = keys.STATE
        history: NestedKey = keys.HISTORY
        plan: NestedKey = keys.PLAN
        mask: NestedKey = "mask"
        noise: NestedKey = "planner_noise"
        time: NestedKey = "planner_time"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_planner"]

    planner: StatePlanner
    planner_params: TensorDictParams
    target_planner_params: TensorDictParams

    def __init__(
        self,
        planner: StatePlanner,
        *,
        window: bool = True,
        create_target_params: bool = True,
        reduction: Literal["none", "mean", "sum"] | None = None,
        first_steps_weight: float = 1.0,
    ):
        super().__init__()
        reduction = "mean" if reduction is None else reduction
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        if first_steps_weight <= 0:
            raise ValueError(f"first_steps_weight must be > 0, got {first_steps_weight}")
        self.step_weights = None
        if first_steps_weight != 1:
            share = torch.linspace(1, 0, planner.horizon)[:, None]
            weights = first_steps_weight**share  # [H, 1]
            self.step_weights = weights / weights.mean()
        self._in_keys = None
        self.window, self.reduction = window, reduction
        self.convert_to_functional(planner, "planner", create_target_params=create_target_params)
        super().set_keys(history=planner.in_keys[0], plan=planner.out_keys[0])

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    def set_keys(self, **kwargs) -> None:
        """Renames entries; ``history`` and ``plan`` are renamed in the planner too."""
        super().set_keys(**kwargs)
        self.planner.set_keys(history=kwargs.get("history"), plan=kwargs.get("plan"))
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that must be there."""
        if self._in_keys is None:
            names = self.tensor_keys
            self._in_keys = [names.state] if self.window else [names.history, names.plan]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes ``loss_planner``; the input is not changed."""
        names = self.tensor_keys
        if self.window:
            history, plan = self.planner.split_window(self._read(tensordict, names.state))
        else:
            history, plan = self._read(tensordict, names.history), self._read(tensordict, names.plan)
        mask = self._read_mask(tensordict, plan)
        if mask is not None:  # before the network: padding may hold anything, and 0 * nan is nan
            plan = torch.where(mask, plan, history[..., -1:, :])

        with self.planner_params.to_module(self.planner, preserve_module_state=False):
            with torch.no_grad():
                condition = self.planner.encode_history(history)
                sample = self.planner.encode_plan(history, plan)
                noise, time = tensordict.get(names.noise, None), tensordict.get(names.time, None)
            error = self.planner.denoising_error(condition, sample, noise, time)  # [*B, H, d]
        if self.step_weights is not None:
            error = error * self.step_weights.to(error)

        if mask is None:
            loss = self._reduce_loss(error)
        elif self.reduction == "none":
            loss = torch.where(mask, error, 0.0)
        else:
            loss = self._reduce_loss(error, mask=mask.expand_as(error))
        result = TensorDict({"loss_planner": loss}, batch_size=[])
        self._clear_weakrefs(tensordict, result, "planner_params", "target_planner_params")
        return result

    @staticmethod
    def _read(tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(
                f"the planner's loss needs the entry {key!r}; there are {sorted(map(str, tensordict.keys(True)))}"
            )
        return value

    def _read_mask(self, tensordict: TensorDictBase, plan: torch.Tensor) -> torch.Tensor | None:
        """Mask of the planned steps ``[*B, H, 1]``, or None."""
        mask = tensordict.get(self.tensor_keys.mask, None)
        if mask is None:
            return None
        if mask.ndim == plan.ndim and mask.shape[-1] == 1:
            mask = mask.squeeze(-1)
        horizon, length = self.planner.horizon, self.planner.history + self.planner.horizon
        if mask.ndim != plan.ndim - 1 or mask.shape[-1] not in (horizon, length):
            raise ValueError(
                f"{self.tensor_keys.mask!r} must be [*B, {horizon}] (horizon) or [*B, {length}] (history + horizon),"
                f" got {list(mask.shape)}"
            )
        return mask[..., -horizon:].bool().unsqueeze(-1)
