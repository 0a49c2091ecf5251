# This source code is licensed under the MIT license found in the LICENSE file.
"""The base class of planner and Diffusion Policy, which sample a sequence given the last observed states."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_koap.keys import HISTORY, check_type, read_entry
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.noise_schedule import SOLVERS, NoiseSchedule


class ConditionalSampler(TensorDictModuleBase):
    """Samples sequences from noise, given the last observed states; a subclass defines the sequences.

    A subclass maps raw sequences to normalised ones and back (:meth:`encode`, :meth:`decode`). Sampling always starts
    from random noise, also under ``ExplorationType.DETERMINISTIC`` (or ``MODE``, ``MEAN``): one fixed start noise would
    give one fixed mode. For reproducible evaluations, write standard normal noise to the entry ``noise_key``.

    Args:
        denoiser (nn.Module): ``denoiser(sequence [*B, H, width], time [*B], condition [*B, h * d + f])`` returns the
            clean sequence.

    Keyword Args:
        state_dim (int): number ``d`` of state columns.
        width (int): number of columns of a sequence.
        out_key (NestedKey): the entry of the sequence ``[*B, H, width]``, raw units.
        relative (bool): the condition holds older frames as displacements from the present one.
        in_key (NestedKey): the entry of the history ``[*B, h, d]``, raw units. Defaults to ``"history"``.
        history (int): number ``h`` of observed frames, the present one included. Defaults to 2.
        horizon (int): number ``H`` of frames of a sequence. Defaults to 14.
        features (nn.Module, optional): ``features(history [*B, h, d]) -> [*B, f]`` with the attribute ``num_features``:
            further entries of the condition, such as relative positions of objects.
        solver (str): a name in ``SOLVERS``. Defaults to ``"dpm++2m"``.
        num_steps (int): solver steps. Defaults to 10.
        noise_key (NestedKey, optional): entry of start noise ``[*B, H, width]``, read if present. Default: ``"noise"``.

    Raises:
        ValueError: for sizes below 1 or an unknown solver; at a call for a history or noise of the wrong shape.
    """

    def __init__(
        self,
        denoiser: nn.Module,
        *,
        state_dim: int,
        width: int,
        out_key: NestedKey,
        relative: bool,
        in_key: NestedKey = HISTORY,
        history: int = 2,
        horizon: int = 14,
        features: nn.Module | None = None,
        solver: str = "dpm++2m",
        num_steps: int = 10,
        noise_key: NestedKey | None = "noise",
    ):
        super().__init__()
        sizes = {"state_dim": state_dim, "width": width, "history": history, "horizon": horizon}
        for name, value in sizes.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.in_keys, self.out_keys, self.noise_key = [in_key], [out_key], noise_key
        self.denoiser, self.schedule = denoiser, NoiseSchedule()
        lookup(SOLVERS, solver, "solver")
        self.schedule.noise_levels(num_steps)  # raises if num_steps is out of range
        self.solver, self.num_steps = solver, num_steps
        self.state_dim, self.history, self.horizon, self.relative = state_dim, history, horizon, relative
        self.features = features
        condition_dim = history * state_dim + (0 if features is None else features.num_features)
        self.condition_normalizer = Normalizer(condition_dim)
        self._width = width

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Shape ``(H, width)`` of a sequence, and so of its start noise."""
        return self.horizon, self._width

    def encode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps raw sequences ``[*B, H, width]``, which follow raw histories ``[*B, h, d]``, to normalised ones."""
        raise NotImplementedError

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps normalised sequences ``[*B, H, width]`` to raw ones; the inverse of :meth:`encode`."""
        raise NotImplementedError

    def check_sequence(self, sequence: Tensor) -> None:
        """Raises a ValueError for sequences that are not ``[*B, H, width]``."""
        _check(sequence, repr(self.out_keys[0]), *self.noise_shape, "horizon, columns")

    def split_window(self, window: Tensor) -> tuple[Tensor, Tensor]:
        """Splits windows of states ``[*B, history + horizon, d]`` into history and future."""
        _check(window, "windows", self.history + self.horizon, self.state_dim, "history + horizon, state_dim")
        return window[..., : self.history, :], window[..., self.history :, :]

    def condition(self, history: Tensor) -> Tensor:
        """Computes the condition ``[*B, h * d + f]`` of raw histories ``[*B, h, d]``, in raw units."""
        displaced = history
        if self.relative:
            now = history[..., -1:, :]
            displaced = torch.cat([history[..., :-1, :] - now, now], -2)
        condition = displaced.flatten(-2)
        return condition if self.features is None else torch.cat([condition, self.features(history)], -1)

    def encode_history(self, history: Tensor) -> Tensor:
        """Maps raw histories ``[*B, h, d]`` to the denoiser's condition ``[*B, h * d + f]``."""
        _check(history, repr(self.in_keys[0]), self.history, self.state_dim, "history, state_dim")
        check_type(self, history, self.in_keys[0])
        return self.condition_normalizer(self.condition(history))

    def far(self, state: Tensor) -> Tensor:
        """Returns which columns of states ``[*B, d]`` exceed the fitted range by more than its width, as bool."""
        end, fitted = self.history * self.state_dim, self.condition_normalizer
        now = slice(end - self.state_dim, end)
        return (state - fitted.offset[now]).abs() > 3 * fitted.scale[now]

    def sample(self, history: Tensor, noise: Tensor | None = None, *, prefix: Tensor | None = None) -> Tensor:
        """Samples sequences ``[*B, H, width]`` for histories ``[*B, h, d]``, both in raw units.

        Args:
            history (Tensor): observed states, the present one last.
            noise (Tensor, optional): start noise ``[*B, H, width]``. Default: drawn.
            prefix (Tensor, optional): prescribed first frames ``[*B, k, width]`` of the sequence, ``k`` below the
                horizon: those that are executed while it is sampled (real-time chunking, arXiv 2506.07339).

        Raises:
            ValueError: for a history, noise or prefix of the wrong shape.
        """
        condition = self.encode_history(history)
        expected = (*history.shape[:-2], *self.noise_shape)
        if noise is None:
            noise = torch.randn(expected, dtype=history.dtype, device=history.device)
        if noise.shape != expected:
            raise ValueError(
                f"{self.noise_key!r} must be {list(expected)} ([*B, horizon, columns]), got {list(noise.shape)}"
            )
        sequence = self.schedule.solve(
            lambda x, time: self.denoiser(x, time, condition),
            noise.to(condition.dtype),
            self.num_steps,
            self.solver,
            prefix=None if prefix is None else self._encode_prefix(history, prefix),
        )
        return self.decode(history, sequence)

    def sample_nearest(
        self, history: Tensor, noise: Tensor | None = None, *, candidates: int, prefix: Tensor | None = None
    ) -> Tensor:
        """Samples several sequences and returns one of the two nearest to each other, ``[*B, H, width]``.

        Distances are those of normalised sequences. Where several routes are possible, a sequence between two has no
        near neighbour. Arguments and errors as for :meth:`sample`; the noise is ``[*B, candidates, H, width]``.
        """

        def repeated(value: Tensor) -> Tensor:
            return value.unsqueeze(-3).expand(*value.shape[:-2], candidates, *value.shape[-2:])

        history, given = repeated(history), {} if prefix is None else {"prefix": repeated(prefix)}
        found = self.sample(history, noise, **given)
        flat = self.encode(history, found).flatten(-2)
        gaps = (flat.unsqueeze(-2) - flat.unsqueeze(-3)).square().sum(-1)
        itself = torch.eye(candidates, dtype=torch.bool, device=flat.device)
        first = gaps.masked_fill(itself, torch.inf).amin(-1).argmin(-1)[..., None, None, None]
        return found.gather(-3, first.expand_as(found[..., :1, :, :])).squeeze(-3)  # exports keep the batch dynamic

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the sampled sequence into the tensordict."""
        noise = None if self.noise_key is None else tensordict.get(self.noise_key, None)
        history = read_entry(self, tensordict, self.in_keys[0])
        return tensordict.set(self.out_keys[0], self.sample(history, noise))

    def _encode_prefix(self, history: Tensor, prefix: Tensor) -> Tensor:
        """Normalises first frames. Every frame has its own statistics, so the sequence is padded for :meth:`encode`."""
        frames = prefix.shape[-2]
        if not 1 <= frames < self.horizon or prefix.shape[-1] != self._width:
            raise ValueError(
                f"a prefix must be [*B, 1..{self.horizon - 1}, {self._width}] (k, columns), got {list(prefix.shape)}"
            )
        rest = prefix[..., -1:, :].expand(*prefix.shape[:-2], self.horizon - frames, -1)
        return self.encode(history, torch.cat([prefix, rest], -2))[..., :frames, :]


def _check(value: Tensor, name: str, frames: int, columns: int, sizes: str) -> None:
    """Raises a ValueError for values that are not ``[*B, frames, columns]``."""
    if value.shape[-2:] != (frames, columns):
        raise ValueError(f"{name} must be [*B, {frames}, {columns}] ({sizes}), got {list(value.shape)}")
