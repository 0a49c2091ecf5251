# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner: a generative model of the next states given the last observed ones. It never sees an action."""

from __future__ import annotations

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_koap import keys
from torchrl_koap.modules.diffusion.base import ConditionedDiffusion, identity_normalizer
from torchrl_koap.modules.diffusion.forecast import LinearForecast
from torchrl_koap.modules.diffusion.noise_schedule import NoiseSchedule
from torchrl_koap.modules.normalizer import Normalizer


class StatePlanner(ConditionedDiffusion):
    """Samples the next ``horizon`` states given the last ``history`` ones: KOAP's pi_PL(x_{t+1:t+H} | x_{t-h+1:t}).

    With ``relative=True`` a plan is modelled as displacements from the current state, and the condition is the
    displacement of the older frames together with the current state itself::

        frame        0      1       2      3          (history = 2)
                     x_0    x_1     x_2    x_3
        condition    x_0-x_1, x_1
        plan                        x_2-x_1, x_3-x_1, ...

    With ``forecast=True`` it is not the plan that is modelled but its deviation from a linear forecast
    (:class:`~torchrl_koap.modules.diffusion.forecast.LinearForecast`), which carries over to goals never seen.

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
        forecast (bool): model deviations from a linear forecast. Defaults to False.
        features (nn.Module, optional): ``features(history [*B, h, d]) -> [*B, f]`` with the attribute ``num_features``:
            further numbers that the condition holds, such as the relative positions of objects.
        solver (str): a name in ``SOLVERS``. Defaults to ``"dpm++2m"``.
        num_steps (int): solver steps. Defaults to 10.
        clip (float, optional): bound of the normalised plan at every solver step. Defaults to no bound; ``1.0`` suits
            ``"minmax"`` statistics.
        in_keys (list of NestedKey): the entry of the history ``[*B, h, d]`` in raw units. Defaults to ``["history"]``.
        out_keys (list of NestedKey): the entry of the plan ``[*B, H, d]`` in raw units. Defaults to ``["plan"]``.
        noise_key (NestedKey, optional): entry of start noise ``[*B, H, d]``, read if present. Defaults to ``"noise"``.

    Raises:
        ValueError: for a history of another length or width, noise of another shape, an unknown solver.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules.diffusion.unet import TemporalUnet
        >>> from torchrl_koap.modules.diffusion.noise_schedule import NoiseSchedule
        >>> from torchrl_koap.modules.diffusion.planner import StatePlanner
        >>> planner = StatePlanner(TemporalUnet(2, 4), NoiseSchedule(), state_dim=2, num_steps=4)
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
        relative: bool = True,
        forecast: bool = False,
        **options,
    ):
        super().__init__(
            denoiser,
            schedule,
            state_dim=state_dim,
            width=state_dim,
            relative=relative,
            in_key=keys.HISTORY,
            out_key=keys.PLAN,
            **options,
        )
        self.plan_normalizer = identity_normalizer(self.horizon * state_dim)
        self.forecast = None
        if forecast:
            self.forecast = LinearForecast(len(self.condition_normalizer.scale), self.horizon * state_dim)

    def set_keys(self, *, history: NestedKey | None = None, plan: NestedKey | None = None) -> None:
        """Renames the entries read and written.

        Keyword Args:
            history (NestedKey, optional): entry of the history.
            plan (NestedKey, optional): entry of the plan.
        """
        self._rename(history, plan)

    def fit_normalizers(
        self,
        windows: Tensor,
        *,
        mode: str = "minmax",
        seen: Tensor | None = None,
        groups: Tensor | None = None,
    ) -> None:
        """Takes the statistics of condition and plan from data; call it before a loss is built on the planner.

        Args:
            windows (Tensor): states in raw units, ``[*N, history + horizon, d]``.

        Keyword Args:
            mode (str): ``"minmax"``, ``"standard"`` or ``"identity"`` (see
                :class:`~torchrl_koap.modules.normalizer.Normalizer`).
            seen (Tensor, optional): the windows as training augments them, which the forecast is fitted to. Default:
                as they are.
            groups (Tensor, optional): trajectory of every window ``[*N]``, for the forecast
                (:meth:`~torchrl_koap.modules.diffusion.forecast.LinearForecast.fit`).
        """
        history, plan = self.split_window(windows.reshape(-1, *windows.shape[-2:]))
        plan = self._modelled(history, plan).flatten(-2)
        condition = self.condition(history)
        example = self.plan_normalizer.scale
        self.condition_normalizer = Normalizer.fit(condition, mode=mode).to(example)
        self.plan_normalizer = Normalizer.fit(plan, mode=mode).to(example)
        if self.forecast is not None:
            history, plan = self.split_window((windows if seen is None else seen).reshape(-1, *windows.shape[-2:]))
            plan = self._modelled(history, plan)
            groups = None if groups is None else groups.flatten()
            self.forecast.fit(self.encode_history(history), self.plan_normalizer(plan.flatten(-2)), groups, mode=mode)

    def _modelled(self, history: Tensor, plan: Tensor) -> Tensor:
        """What is modelled of raw plans ``[*B, H, d]``."""
        return plan - history[..., -1:, :] if self.relative else plan

    def encode_plan(self, history: Tensor, plan: Tensor) -> Tensor:
        """Raw plans to the normalised sequences that noise is added to.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            plan (Tensor): raw plans ``[*B, H, d]``.

        Returns:
            Tensor: normalised sequences ``[*B, H, d]``.

        Raises:
            ValueError: for plans of another shape.
        """
        if plan.shape[-2:] != (self.horizon, self.state_dim):
            raise ValueError(
                f"{self.out_keys[0]!r} must be [*B, {self.horizon}, {self.state_dim}] (horizon, state_dim),"
                f" got {list(plan.shape)}"
            )
        sequence = self.plan_normalizer(self._modelled(history, plan).flatten(-2))
        if self.forecast is not None:
            sequence = self.forecast.take_off(self.encode_history(history), sequence)
        return sequence.unflatten(-1, self.noise_shape)

    def decode_plan(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Inverse of :meth:`encode_plan`.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            sequence (Tensor): normalised sequences ``[*B, H, d]``.

        Returns:
            Tensor: raw plans ``[*B, H, d]``.
        """
        sequence = sequence.flatten(-2)
        if self.forecast is not None:
            sequence = self.forecast.add(self.encode_history(history), sequence)
        plan = self.plan_normalizer.inverse(sequence).unflatten(-1, self.noise_shape)
        return plan + history[..., -1:, :] if self.relative else plan

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Raw plans of normalised sequences: :meth:`decode_plan`.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            sequence (Tensor): normalised sequences ``[*B, H, d]``.

        Returns:
            Tensor: raw plans ``[*B, H, d]``.
        """
        return self.decode_plan(history, sequence)

    def scale_columns(self, plan: Tensor) -> Tensor:
        """Raw plan ``[*B, H, d]`` in units of the columns' spread, the same for all its steps."""
        return plan / self.plan_normalizer.scale.unflatten(-1, self.noise_shape).mean(0)

    def plan(
        self,
        history: Tensor,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        *,
        known: Tensor | None = None,
    ) -> Tensor:
        """Samples plans ``[*B, H, d]`` for histories ``[*B, h, d]``, both in raw units.

        Args:
            history (Tensor): observed states, the present one last.
            noise (Tensor, optional): as for :meth:`solve`.
            generator (torch.Generator, optional): source of what is drawn.

        Keyword Args:
            known (Tensor, optional): first states ``[*B, k, d]`` that the plan has to have, ``k`` below the horizon:
                what is executed anyway while the plan is being made (real-time chunking, arXiv 2506.07339).

        Raises:
            ValueError: for a history, noise or known states of another shape.
        """
        if known is None:
            return self.sample(history, noise, generator)
        frames = known.shape[-2]
        if not 1 <= frames < self.horizon or known.shape[-1] != self.state_dim:
            raise ValueError(
                f"known states must be [*B, 1..{self.horizon - 1}, {self.state_dim}] (k, state_dim),"
                f" got {list(known.shape)}"
            )
        rest = known[..., -1:, :].expand(*known.shape[:-2], self.horizon - frames, -1)
        fixed = self.encode_plan(history, torch.cat([known, rest], -2))
        return self.decode_plan(history, self.solve(history, noise, generator, fixed[..., :frames, :]))
