# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner: a generative model of the next states given the last observed ones. It never sees an action."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import nn

from torchrl_koap import keys
from torchrl_koap.modules.diffusion.base import ConditionedDiffusion, identity_normalizer
from torchrl_koap.modules.diffusion.schedule import NoiseSchedule
from torchrl_koap.modules.normalizer import Normalizer

Tensor = torch.Tensor


class StatePlanner(ConditionedDiffusion):
    """Samples the next ``horizon`` states given the last ``history`` ones: KOAP's pi_PL(x_{t+1:t+H} | x_{t-h+1:t}).

    With ``relative=True`` a plan is modelled as displacements from the current state, and the condition is the
    displacement of the older frames together with the current state itself::

        frame        0      1       2      3          (history = 2)
                     x_0    x_1     x_2    x_3
        condition    x_0-x_1, x_1
        plan                        x_2-x_1, x_3-x_1, ...

    Every entry of condition and plan has its own offset and scale (:meth:`fit_normalizers`); they travel in the state
    dict.

    Sampling always starts from random noise, also under ``ExplorationType.DETERMINISTIC`` (or ``MODE``, ``MEAN``),
    where only a stochastic solver is exchanged for its deterministic sibling ``"ddim"``: one fixed start noise would
    give one fixed mode. For evaluations that can be repeated per environment put standard normal noise into the entry
    ``noise_key``.

    Args:
        denoiser (nn.Module): ``denoiser(sequence [*B, H, d], time [*B], condition [*B, h * d + f]) -> [*B, H, d]``.
        schedule (NoiseSchedule, optional): noise schedule and prediction type. Defaults to ``NoiseSchedule()``, the
            50 steps, squared cosine and noise prediction of KOAP's first public code.

    Keyword Args:
        state_dim (int): number ``d`` of state columns.
        history (int): number ``h`` of observed frames, the current one included. Defaults to 2.
        horizon (int): number ``H`` of planned frames. Defaults to 14.
        relative (bool): model displacements from the current state. Defaults to True.
        features (nn.Module, optional): ``features(history [*B, h, d]) -> [*B, f]`` with the attribute ``num_features``:
            further numbers that the condition holds, such as :class:`~torchrl_koap.tasks.relative_positions.Relations`.
        solver (str, optional): a name in ``SOLVERS``. Defaults to ``"dpm++2m"`` on a diffusion and ``"heun"`` on a
            flow path.
        num_steps (int): solver steps. Defaults to 10.
        clip (float, optional): bound of the normalised plan at every solver step. Defaults to no bound; ``1.0`` suits
            ``"minmax"`` statistics.
        in_keys (list of NestedKey): the entry of the history ``[*B, h, d]`` in raw units. Defaults to ``["history"]``.
        out_keys (list of NestedKey): the entry of the plan ``[*B, H, d]`` in raw units. Defaults to ``["plan"]``.
        noise_key (NestedKey, optional): entry read if present: start noise ``[*B, H, d]``, or ``[*B, 1 + num_steps,
            H, d]`` where the rest are the draws of a stochastic solver. Defaults to ``"noise"``.

    Raises:
        ValueError: for a history of another length or width, noise of another shape, an unknown or unfit solver.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules.diffusion.unet import TemporalUnet
        >>> from torchrl_koap.modules.diffusion.schedule import NoiseSchedule
        >>> from torchrl_koap.modules.diffusion.planner import StatePlanner
        >>> planner = StatePlanner(TemporalUnet(2, 4), NoiseSchedule("flow"), state_dim=2, num_steps=4)
        >>> windows = torch.randn(100, 16, 2).cumsum(1)
        >>> planner.fit_normalizers(windows)
        >>> planner(TensorDict({"history": windows[:5, :2]}, [5]))["plan"].shape
        torch.Size([5, 14, 2])
    """

    def __init__(
        self,
        denoiser: nn.Module,
        schedule: NoiseSchedule | None = None,
        *,
        state_dim: int,
        history: int = 2,
        horizon: int = 14,
        relative: bool = True,
        features: nn.Module | None = None,
        solver: str | None = None,
        num_steps: int = 10,
        clip: float | None = None,
        in_keys: list[NestedKey] | None = None,
        out_keys: list[NestedKey] | None = None,
        noise_key: NestedKey | None = "noise",
    ):
        super().__init__(
            denoiser,
            schedule,
            state_dim=state_dim,
            width=state_dim,
            history=history,
            horizon=horizon,
            relative=relative,
            features=features,
            solver=solver,
            num_steps=num_steps,
            clip=clip,
            in_keys=[keys.HISTORY] if in_keys is None else in_keys,
            out_keys=[keys.PLAN] if out_keys is None else out_keys,
            noise_key=noise_key,
        )
        self.plan_normalizer = identity_normalizer(horizon * state_dim)

    def set_keys(self, *, history: NestedKey | None = None, plan: NestedKey | None = None) -> None:
        """Renames the entries read and written."""
        if history is not None:
            self.in_keys = [history]
        if plan is not None:
            self.out_keys = [plan]

    def fit_normalizers(self, windows: Tensor, *, mode: str = "minmax", per_step: bool = True) -> None:
        """Takes the statistics of condition and plan from data; call it before a loss is built on the planner.

        Args:
            windows (Tensor): states in raw units, ``[*N, history + horizon, d]``.

        Keyword Args:
            mode (str): ``"minmax"``, ``"standard"`` or ``"identity"`` (see
                :class:`~torchrl_koap.modules.normalizer.Normalizer`).
            per_step (bool): own statistics for every planned step instead of shared ones. Defaults to True.
        """
        history, plan = self.split_window(windows.reshape(-1, *windows.shape[-2:]))
        plan = plan - history[..., -1:, :] if self.relative else plan
        if per_step:
            plan = plan.flatten(-2)
        else:
            plan = plan.reshape(-1, self.state_dim).repeat(1, self.horizon)
        condition = self.condition(history)
        example = self.plan_normalizer.scale
        self.condition_normalizer = Normalizer.fit(condition, mode=mode).to(example)
        self.plan_normalizer = Normalizer.fit(plan, mode=mode).to(example)

    def encode_plan(self, history: Tensor, plan: Tensor) -> Tensor:
        """Raw plan ``[*B, H, d]`` to the normalised sequence that noise is added to."""
        if plan.shape[-2:] != (self.horizon, self.state_dim):
            raise ValueError(
                f"{self.out_keys[0]!r} must be [*B, {self.horizon}, {self.state_dim}] (horizon, state_dim),"
                f" got {list(plan.shape)}"
            )
        plan = plan - history[..., -1:, :] if self.relative else plan
        return self.plan_normalizer(plan.flatten(-2)).unflatten(-1, (self.horizon, self.state_dim))

    def decode_plan(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Inverse of :meth:`encode_plan`."""
        plan = self.plan_normalizer.inverse(sequence.flatten(-2)).unflatten(-1, (self.horizon, self.state_dim))
        return plan + history[..., -1:, :] if self.relative else plan

    def scale_columns(self, plan: Tensor) -> Tensor:
        """Raw plan ``[*B, H, d]`` in units of the columns' spread, the same for all its steps."""
        return plan / self.plan_normalizer.scale.unflatten(-1, (self.horizon, self.state_dim)).mean(0)

    def plan(self, history: Tensor, noise: Tensor | None = None, generator: torch.Generator | None = None) -> Tensor:
        """Samples plans ``[*B, H, d]`` for histories ``[*B, h, d]``, both in raw units; see the class for ``noise``."""
        return self.decode_plan(history, self.solve(history, noise, generator))

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the plan into the tensordict."""
        noise = None if self.noise_key is None else tensordict.get(self.noise_key, None)
        return tensordict.set(self.out_keys[0], self.plan(tensordict.get(self.in_keys[0]), noise))
