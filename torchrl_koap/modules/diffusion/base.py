# This source code is licensed under the MIT license found in the LICENSE file.
"""What the planner and the Diffusion Policy share: a sequence sampled given the last observed states."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.diffusion.noise_schedule import SOLVERS, NoiseSchedule
from torchrl_koap.modules.normalizer import Normalizer


class ConditionedDiffusion(TensorDictModuleBase):
    """Base of the generative models: condition, start noise and solver; subclasses say what the sequence is.

    A subclass encodes and decodes the diffused sequence ``[*B, H, width]`` in units of its own (:meth:`decode`); what
    is said here once is the condition, the start noise, the solver, the sampling and the entries.

    Args:
        denoiser (nn.Module): ``denoiser(sequence [*B, H, width], time [*B], condition [*B, h * d + f])``, of the shape
            of the sequence.
        schedule (NoiseSchedule, optional): noise schedule and prediction type. Defaults to ``NoiseSchedule()``.

    Keyword Args:
        state_dim (int): number ``d`` of state columns.
        width (int): columns of the diffused sequence.
        in_key (NestedKey): default entry of the history.
        out_key (NestedKey): default entry of the sequence.
        history (int): number ``h`` of observed frames, the current one included. Defaults to 2.
        horizon (int): number ``H`` of frames of the sequence. Defaults to 14.
        relative (bool): the condition holds the older frames as displacements from the current one.
        features (nn.Module, optional): ``features(history [*B, h, d]) -> [*B, f]`` with ``num_features``.
        solver (str): a name in ``SOLVERS``. Defaults to ``"dpm++2m"``.
        num_steps (int): solver steps. Defaults to 10.
        clip (float, optional): bound of the normalised sequence at every solver step. Defaults to no bound.
        in_keys (list of NestedKey, optional): the entry of the history, instead of ``in_key``.
        out_keys (list of NestedKey, optional): the entry of the sequence, instead of ``out_key``.
        noise_key (NestedKey, optional): entry of the start noise, read if present. Defaults to ``"noise"``.

    Raises:
        ValueError: for sizes below 1, several in- or out-keys, an unknown solver.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import StatePlanner, TemporalUnet  # a subclass, of states
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2, horizon=14)
        >>> planner.noise_shape, planner.sample(torch.zeros(3, 2, 2)).shape
        ((14, 2), torch.Size([3, 14, 2]))
    """

    width_name = "state_dim"

    def __init__(
        self,
        denoiser: nn.Module,
        schedule: NoiseSchedule | None,
        *,
        state_dim: int,
        width: int,
        in_key: NestedKey,
        out_key: NestedKey,
        relative: bool,
        history: int = 2,
        horizon: int = 14,
        features: nn.Module | None = None,
        solver: str = "dpm++2m",
        num_steps: int = 10,
        clip: float | None = None,
        in_keys: list[NestedKey] | None = None,
        out_keys: list[NestedKey] | None = None,
        noise_key: NestedKey | None = "noise",
    ):
        super().__init__()
        sizes = {"state_dim": state_dim, self.width_name: width, "history": history, "horizon": horizon}
        for name, value in sizes.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.in_keys = [in_key] if in_keys is None else list(in_keys)
        self.out_keys = [out_key] if out_keys is None else list(out_keys)
        if len(self.in_keys) != 1 or len(self.out_keys) != 1:
            raise ValueError(f"one in_key and one out_key are needed, got {self.in_keys} and {self.out_keys}")
        self.denoiser = denoiser
        self.schedule = NoiseSchedule() if schedule is None else schedule
        self.state_dim, self.history, self.horizon, self.relative = state_dim, history, horizon, relative
        self.clip, self.noise_key = clip, noise_key
        self.training_dtype: torch.dtype | None = None  # of the denoiser's matrix products in denoising_error
        self.features = features
        self.condition_normalizer = identity_normalizer(
            history * state_dim + (0 if features is None else features.num_features)
        )
        self._width = width
        self.solver = solver
        self.num_steps = num_steps

    @property
    def solver(self) -> str:
        """Name of the solver; may be set at any time."""
        return self._solver

    @solver.setter
    def solver(self, name: str) -> None:
        lookup(SOLVERS, name, "solver")
        self._solver = name

    @property
    def num_steps(self) -> int:
        """Number of solver steps; may be set at any time."""
        return self._num_steps

    @num_steps.setter
    def num_steps(self, number: int) -> None:
        self.schedule.noise_levels(number)
        self._num_steps = number

    def _rename(self, history: NestedKey | None, sequence: NestedKey | None) -> None:
        if history is not None:
            self.in_keys = [history]
        if sequence is not None:
            self.out_keys = [sequence]

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Shape ``(H, width)`` of the start noise of one sequence, and of the sequence itself."""
        return self.horizon, self._width

    def split_window(self, window: Tensor) -> tuple[Tensor, Tensor]:
        """Cuts windows of states ``[*B, history + horizon, d]`` into history and future."""
        length = self.history + self.horizon
        if window.ndim < 2 or window.shape[-2] != length or window.shape[-1] != self.state_dim:
            raise ValueError(
                f"windows must be [*B, {length}, {self.state_dim}] (history + horizon, state_dim),"
                f" got {list(window.shape)}"
            )
        return window[..., : self.history, :], window[..., self.history :, :]

    def encode_history(self, history: Tensor) -> Tensor:
        """Raw history ``[*B, h, d]`` to the denoiser's condition ``[*B, h * d + f]``."""
        if history.ndim < 2 or history.shape[-2:] != (self.history, self.state_dim):
            raise ValueError(
                f"{self.in_keys[0]!r} must be [*B, {self.history}, {self.state_dim}] (history, state_dim),"
                f" got {list(history.shape)}"
            )
        return self.condition_normalizer(self.condition(history))

    def condition(self, history: Tensor) -> Tensor:
        """The condition ``[*B, h * d + f]`` in raw units."""
        if self.relative:
            now = history[..., -1:, :]
            displaced = torch.cat([history[..., :-1, :] - now, now], -2)
        else:
            displaced = history
        condition = displaced.flatten(-2)
        return condition if self.features is None else torch.cat([condition, self.features(history)], -1)

    def draw_noise(self, history: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Start noise, standard normal.

        Args:
            history (Tensor): histories ``[*B, h, d]``, for shape, type and device.
            generator (torch.Generator, optional): source of the numbers.

        Returns:
            Tensor: ``[*B, H, width]``.
        """
        shape = (*history.shape[:-2], *self.noise_shape)
        return torch.randn(shape, dtype=history.dtype, device=history.device, generator=generator)

    def denoising_error(
        self, condition: Tensor, sample: Tensor, noise: Tensor | None = None, time: Tensor | None = None
    ) -> Tensor:
        """Squared error ``[*B, H, width]`` of the denoiser on noised sequences: what training minimises.

        Args:
            condition (Tensor): of :meth:`encode_history`, ``[*B, h * d + f]``.
            sample (Tensor): clean normalised sequences ``[*B, H, width]``.
            noise (Tensor, optional): of the same shape. Default: random.
            time (Tensor, optional): ``[*B]`` in training steps. Default: random.
        """
        with torch.no_grad():
            noise = torch.randn_like(sample) if noise is None else noise
            time = self.schedule.sample_time(sample) if time is None else time.to(sample.dtype)
            noisy, target = self.schedule.add_noise(sample, noise, time), self.schedule.target(sample, noise)
        with torch.autocast(sample.device.type, self.training_dtype, enabled=self.training_dtype is not None):
            predicted = self.denoiser(noisy, time, condition)
        return (predicted - target).square()

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Raw plans or actions of normalised sequences; a subclass says how.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            sequence (Tensor): normalised sequences ``[*B, H, width]``.

        Returns:
            Tensor: ``[*B, H, width]`` in raw units.
        """
        raise NotImplementedError

    def sample(self, history: Tensor, noise: Tensor | None = None, generator: torch.Generator | None = None) -> Tensor:
        """Samples sequences ``[*B, H, width]`` for histories ``[*B, h, d]``, both in raw units.

        Args:
            history (Tensor): raw history.
            noise (Tensor, optional): start noise ``[*B, H, width]``. Default: drawn.
            generator (torch.Generator, optional): source of what is drawn.

        Raises:
            ValueError: for a history or noise of another shape.
        """
        return self.decode(history, self.solve(history, noise, generator))

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the sampled sequence into the tensordict."""
        noise = None if self.noise_key is None else tensordict.get(self.noise_key, None)
        return tensordict.set(self.out_keys[0], self.sample(tensordict.get(self.in_keys[0]), noise))

    def _check_sequence(self, sequence: Tensor) -> None:
        if sequence.shape[-2:] != self.noise_shape:
            raise ValueError(
                f"{self.out_keys[0]!r} must be [*B, {self.horizon}, {self._width}] (horizon, {self.width_name}),"
                f" got {list(sequence.shape)}"
            )

    def solve(
        self,
        history: Tensor,
        noise: Tensor | None,
        generator: torch.Generator | None,
        known: Tensor | None = None,
    ) -> Tensor:
        """Samples normalised sequences ``[*B, H, width]`` for raw histories ``[*B, h, d]``.

        Args:
            history (Tensor): raw history.
            noise (Tensor, optional): start noise ``[*B, H, width]``. Default: drawn.
            generator (torch.Generator, optional): source of what is drawn.
            known (Tensor, optional): normalised first frames ``[*B, k, width]`` that the sequence has to have.

        Raises:
            ValueError: for a history or noise of another shape.
        """
        condition = self.encode_history(history)
        if noise is None:
            noise = self.draw_noise(history, generator)
        expected = (*history.shape[:-2], *self.noise_shape)
        if noise.shape != expected:
            raise ValueError(
                f"{self.noise_key!r} must be {list(expected)} ([*B, horizon, {self.width_name}]), got"
                f" {list(noise.shape)}"
            )
        return self.schedule.solve(
            lambda x, time: self.denoiser(x, time, condition),
            noise,
            self.num_steps,
            self.solver,
            clip=self.clip,
            prefix=known,
        )


def identity_normalizer(width: int) -> Normalizer:
    """A normaliser of that many columns that changes nothing until statistics are loaded or fitted."""
    return Normalizer(torch.zeros(width), torch.ones(width))
