# This source code is licensed under the MIT license found in the LICENSE file.
"""The noise schedule of planner and Diffusion Policy, and the solvers that remove the noise.

A noisy sequence at time ``t`` is

    x_t = signal(t) x_0 + noise(t) eps,    eps ~ N(0, I),    signal^2 + noise^2 = 1

with ``t`` counted in training steps ``0 .. 49``. Networks predict ``x_0``. Solvers remove noise level by level. They
are pure functions in :data:`SOLVERS`; a new solver is one function and one entry there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchrl_koap.lookup import lookup

NUM_TRAIN_STEPS = 50


class NoiseLevel(NamedTuple):
    """One noise level of a solver: time in training steps, and the amplitudes of signal and noise."""

    time: float
    signal: float
    noise: float


Denoise = Callable[[Tensor, NoiseLevel], Tensor]


def ddim(denoise: Denoise, x: Tensor, levels: Sequence[NoiseLevel]) -> Tensor:
    """Samples clean sequences ``[*B, H, d]`` by DDIM (Song et al. 2021, eq. 12 with eta = 0).

    ``denoise(x, level)`` predicts the clean sequence from ``x``, which is pure noise ``[*B, H, d]`` at first. Levels
    decrease to no noise; there is one more level than steps.
    """
    for level, after in zip(levels[:-1], levels[1:], strict=True):
        sample = denoise(x, level)
        x = sample * after.signal + (x - sample * level.signal) / level.noise * after.noise
    return x


def dpm_solver_2m(denoise: Denoise, x: Tensor, levels: Sequence[NoiseLevel]) -> Tensor:
    """Samples as :func:`ddim`, by a second-order multistep solver in the log-SNR (Lu et al. 2022, algorithm 2)."""
    previous, previous_step = None, 0.0
    for level, after in zip(levels[:-1], levels[1:], strict=True):
        sample = denoise(x, level)
        if after.noise == 0:
            return sample * after.signal
        step = math.log(after.signal / after.noise) - math.log(level.signal / level.noise)
        slope = sample
        if previous is not None:
            slope = sample + (sample - previous) * (0.5 * step / previous_step)
        x = x * (after.noise / level.noise) - slope * (after.signal * math.expm1(-step))
        previous, previous_step = sample, step
    return x


SOLVERS = {"dpm++2m": dpm_solver_2m, "ddim": ddim}


class NoiseSchedule(nn.Module):
    """Adds noise to sequences, and removes it.

    The variance of the signal decreases nearly as a squared cosine over 50 steps (Nichol and Dhariwal 2021).
    """

    def __init__(self):
        super().__init__()
        with torch.device("cpu"):  # values are read below, which a meta tensor would not have
            edges = torch.arange(NUM_TRAIN_STEPS + 1, dtype=torch.float64) / NUM_TRAIN_STEPS
            kept = torch.cos((edges + 0.008) / 1.008 * math.pi / 2).square()
            variance = (kept[1:] / kept[:-1]).clamp_min(1e-3).cumprod(0)
        signal, noise = variance.sqrt(), (1 - variance).sqrt()
        # Python numbers for solvers: exact in every dtype, no device synchronisation, constants for torch.compile.
        self._levels = tuple(zip(signal.tolist(), noise.tolist(), strict=True))
        default = {"dtype": torch.get_default_dtype(), "device": torch.get_default_device()}
        self.register_buffer("signal", signal.to(**default))
        self.register_buffer("noise", noise.to(**default))

    def sample_time(self, like: Tensor) -> Tensor:
        """Draws times ``[*B]``, in training steps, with dtype and device of sequences ``[*B, H, d]``."""
        return torch.randint(NUM_TRAIN_STEPS, like.shape[:-2], device=like.device).to(like.dtype)

    def add_noise(self, sample: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Computes noisy sequences ``signal(t) x_0 + noise(t) eps``, ``[*B, H, d]``, at times ``[*B]``."""
        index = time.long()
        signal, amplitude = self.signal[index].to(time.dtype), self.noise[index].to(time.dtype)
        return signal[..., None, None] * sample + amplitude[..., None, None] * noise

    def noise_levels(self, num_steps: int) -> list[NoiseLevel]:
        """Returns the ``num_steps + 1`` levels of a solver, evenly spaced from the noisiest level to no noise."""
        if not 1 <= num_steps <= NUM_TRAIN_STEPS:
            raise ValueError(f"num_steps must lie in 1..{NUM_TRAIN_STEPS}, the steps of training, got {num_steps}")
        times = [round(NUM_TRAIN_STEPS * (num_steps - step) / num_steps) - 1 for step in range(num_steps)]
        return [*(NoiseLevel(float(time), *self._levels[time]) for time in times), NoiseLevel(0.0, 1.0, 0.0)]

    def solve(
        self,
        network: Callable[[Tensor, Tensor], Tensor],
        noise: Tensor,
        num_steps: int,
        solver: str = "dpm++2m",
        *,
        prefix: Tensor | None = None,
    ) -> Tensor:
        """Turns standard normal noise ``[*B, H, d]`` into sequences, by ``network(x [*B, H, d], time [*B])``.

        The network predicts the clean sequence. A ``prefix`` ``[*B, k, d]`` replaces its first frames at every step, so
        that the rest fits it. Errors as for :meth:`noise_levels`, and a ValueError for an unknown solver.
        """
        run, levels, batch = lookup(SOLVERS, solver, "solver"), self.noise_levels(num_steps), noise.shape[:-2]

        def denoise(x: Tensor, level: NoiseLevel) -> Tensor:
            sample = network(x, x.new_full(batch, level.time))
            return sample if prefix is None else torch.cat([prefix, sample[..., prefix.shape[-2] :, :]], -2)

        return run(denoise, noise, levels)
