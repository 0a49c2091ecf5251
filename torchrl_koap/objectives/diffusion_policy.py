# This source code is licensed under the MIT license found in the LICENSE file.
"""The Diffusion Policy's training loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torchrl_koap import keys
from torchrl_koap.modules.diffusion.policy import DiffusionPolicy
from torchrl_koap.objectives.base import read_entry, read_mask


class DiffusionPolicyLoss(LossModule):
    r"""Mean squared error of the denoiser of actions at random noise levels, on labelled steps.

    With the normalised actions ``a`` of frames ``history - 1 .. T - 2`` of a window, noise ``eps ~ N(0, I)`` and a
    random time ``t`` per window,

        L = mean over labelled steps | denoiser(signal(t) a + noise(t) eps, t, condition) - target |^2

    where the schedule's prediction type says whether the target is the noise, the clean actions or the velocity.

    A step counts if it has a label and neither its frame nor the next one is padded. The denoiser sees steps that do
    not count as the middle of the range of actions, noise added; what was stored there (NaN) reaches neither value
    nor gradient. A batch without labels gives exactly 0. Labels are what this method lives on: draw windows with
    ``labelled_share=1`` (:class:`~torchrl_koap.data.WindowSampler`).

    Args:
        policy (DiffusionPolicy): policy to train, its normalisers already fitted.

    Keyword Args:
        create_target_params (bool): keep an averaged copy of the weights in ``target_policy_params``, to be moved by
            :class:`torchrl.objectives.SoftUpdate` and used for control. Defaults to True.
        reduction (str): ``"mean"`` | ``"sum"`` | ``"none"`` over the elements ``[*B, H, act]`` that count (``"none"``:
            0 where they do not). Defaults to ``"mean"``.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if an entry has another shape than the policy needs, or ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_koap.modules import DiffusionPolicy, TemporalUnet
        >>> from torchrl_koap.objectives import DiffusionPolicyLoss
        >>> policy = DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3)
        >>> loss = DiffusionPolicyLoss(policy)
        >>> average = SoftUpdate(loss, eps=0.99)
        >>> batch = TensorDict({"state": torch.randn(8, 16, 2), "action": torch.randn(8, 16, 3),
        ...                     "has_action": torch.ones(8, 16, 1, dtype=torch.bool)}, [8])
        >>> loss(batch)["loss_policy"].backward()
        >>> average.step()
        >>> with loss.target_policy_params.to_module(policy):
        ...     actions = policy.sample(torch.randn(3, 2, 2))
    """

    @dataclass
    class _AcceptedKeys:
        """Entries of the input; the last three are read if they are there.

        Attributes:
            state (NestedKey): windows of raw states ``[*B, history + horizon, d]``. Defaults to ``"state"``.
            action (NestedKey): raw actions ``[*B, history + horizon, act]``, NaN where unlabelled. Defaults to
                ``"action"``.
            has_action (NestedKey): labelled frames, bool ``[*B, history + horizon, 1]``. Defaults to ``"has_action"``.
            padded (NestedKey): frames that repeat an edge of the trajectory, bool ``[*B, history + horizon]``. Defaults
                to ``"padded"``.
            noise (NestedKey): noise ``[*B, horizon, act]`` instead of random. Defaults to ``"policy_noise"``.
            time (NestedKey): time ``[*B]`` in training steps instead of random. Defaults to ``"policy_time"``.

        The two masks may have a trailing 1 or not.
        """

        state: NestedKey = keys.STATE
        action: NestedKey = keys.ACTION
        has_action: NestedKey = keys.HAS_ACTION
        padded: NestedKey = "padded"
        noise: NestedKey = "policy_noise"
        time: NestedKey = "policy_time"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_policy"]

    policy: DiffusionPolicy
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams

    def __init__(
        self,
        policy: DiffusionPolicy,
        *,
        create_target_params: bool = True,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__()
        reduction = "mean" if reduction is None else reduction
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        self.reduction = reduction
        self.convert_to_functional(policy, "policy", create_target_params=create_target_params)

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """There is no value estimator."""

    def train(self, mode: bool = True):
        """Sets the mode of the loss, and of the policy, which is no submodule of it."""
        super().train(mode)
        self.policy.train(mode)
        return self

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that must be there, as renamed by ``set_keys``."""
        return [self.tensor_keys.state, self.tensor_keys.action, self.tensor_keys.has_action]

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        raise RuntimeError("in_keys follow the keys of the loss: use set_keys")

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes ``loss_policy``; the input is not changed."""
        names = self.tensor_keys
        state = read_entry(tensordict, names.state)
        history, _ = self.policy.split_window(state)
        action, counts = self._actions(tensordict, state)

        with self.policy_params.to_module(self.policy, preserve_module_state=False):
            with torch.no_grad():
                condition = self.policy.encode_history(history)
                # before the network and the residual: masking afterwards would leave NaN in the gradient
                sample = self.policy.encode_actions(torch.where(counts, action, 0.0))
                sample = torch.where(counts, sample, 0.0)
                noise, time = tensordict.get(names.noise, None), tensordict.get(names.time, None)
            error = self.policy.denoising_error(condition, sample, noise, time)  # [*B, H, act]

        loss = torch.where(counts, error, 0.0)
        if self.reduction != "none":
            loss = loss.sum()
        if self.reduction == "mean":
            loss = loss / (counts.sum() * self.policy.action_dim).clamp_min(1)
        result = TensorDict({"loss_policy": loss}, batch_size=[])
        self._clear_weakrefs(tensordict, result, "policy_params", "target_policy_params")
        return result

    def _actions(self, tensordict: TensorDictBase, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions of the current and later steps ``[*B, H, act]``, and which of them count ``[*B, H, 1]``."""
        names, now = self.tensor_keys, self.policy.history - 1
        action = read_entry(tensordict, names.action)
        wanted = (*state.shape[:-1], self.policy.action_dim)
        if action.shape != wanted:
            raise ValueError(f"{names.action!r} must be {list(wanted)} ([*B, T, act]), got {list(action.shape)}")
        counts = read_mask(tensordict, names.has_action, state)[..., now:-1]
        if tensordict.get(names.padded, None) is not None:
            padded = read_mask(tensordict, names.padded, state)[..., now:]
            counts = counts & ~(padded[..., 1:] | padded[..., :-1])
        return action[..., now:-1, :], counts.unsqueeze(-1)
