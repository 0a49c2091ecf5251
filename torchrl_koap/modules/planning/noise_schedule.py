# This source code is licensed under the MIT license found in the LICENSE file.
"""The noise schedule of planner and Diffusion Policy, and the solvers that remove the noise again.

A noisy sequence at time ``t`` is

    x_t = signal(t) x_0 + noise(t) eps,    eps ~ N(0, I),    signal^2 + noise^2 = 1

with ``t`` counted in training steps ``0 .. N-1``. Solvers walk from much noise to none: pure functions in
:data:`SOLVERS`, to which adding one is a function and a line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchrl_koap.lookup import lookup

PREDICTIONS = ("sample", "epsilon")


class NoiseLevel(NamedTuple):
    """One stop of a solver: time in training steps, amplitude of the signal and of the noise there."""

    time: float
    signal: float
    noise: float


Denoise = Callable[[Tensor, NoiseLevel], tuple[Tensor, Tensor]]


def ddim(denoise: Denoise, x: Tensor, levels: Sequence[NoiseLevel]) -> Tensor:
    """Deterministic implicit sampling (Song et al. 2021, eq. 12 with eta = 0): clean sequences ``[*B, H, d]``.

    Args:
        denoise (callable): ``denoise(x, level)`` gives the clean sequence and the noise that the network sees in ``x``,
            both ``[*B, H, d]``.
        x (Tensor): start noise ``[*B, H, d]``.
        levels (sequence of NoiseLevel): stops from much noise to none, one more than steps.
    """
    for level, after in zip(levels[:-1], levels[1:], strict=True):
        sample, epsilon = denoise(x, level)
        x = sample * after.signal + epsilon * after.noise
    return x


def dpm_solver_2m(denoise: Denoise, x: Tensor, levels: Sequence[NoiseLevel]) -> Tensor:
    """Second-order multistep solver in the log signal-to-noise ratio (Lu et al. 2022, algorithm 2).

    Args as for :func:`ddim`.
    """
    previous, previous_step = None, 0.0
    for level, after in zip(levels[:-1], levels[1:], strict=True):
        sample, _ = denoise(x, level)
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


def squared_cosine(num_train_steps: int) -> Tensor:
    """Computes the signal variance after each step, nearly a squared cosine (Nichol and Dhariwal 2021), float64."""
    edges = torch.arange(num_train_steps + 1, dtype=torch.float64) / num_train_steps
    kept = torch.cos((edges + 0.008) / 1.008 * math.pi / 2).square()
    return (kept[1:] / kept[:-1]).clamp_min(1e-3).cumprod(0)


class NoiseSchedule(nn.Module):
    """Adds noise to sequences of a squared-cosine schedule, says what a network predicts, and removes noise again.

    Args:
        prediction (str): what the network predicts, ``"sample"`` the clean sequence or ``"epsilon"`` the noise.
            Defaults to ``"sample"``.
        num_train_steps (int): number ``N`` of noise levels in training. Defaults to 50.

    Raises:
        ValueError: for an unknown prediction (the nearest name is suggested), or fewer than one step.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import NoiseSchedule
        >>> schedule = NoiseSchedule()
        >>> plan, noise = torch.ones(3, 14, 2), torch.randn(3, 14, 2)
        >>> solved = schedule.solve(lambda x, time: plan, noise, num_steps=4)
        >>> torch.allclose(solved, plan, atol=1e-5)
        True
    """

    def __init__(self, prediction: str = "sample", num_train_steps: int = 50):
        super().__init__()
        lookup(PREDICTIONS, prediction, "prediction")
        if num_train_steps < 1:
            raise ValueError(f"num_train_steps must be at least 1, got {num_train_steps}")
        self.prediction, self.num_train_steps = prediction, num_train_steps
        with torch.device("cpu"):  # the numbers are read below, also where modules are built without storage
            variance = squared_cosine(num_train_steps)
        signal, noise = variance.sqrt(), (1 - variance).sqrt()
        # Solvers read numbers from here: exact in every dtype, no device synchronisation, constants for torch.compile.
        self._levels = tuple(zip(signal.tolist(), noise.tolist(), strict=True))
        default = {"dtype": torch.get_default_dtype(), "device": torch.get_default_device()}
        self.register_buffer("signal", signal.to(**default))
        self.register_buffer("noise", noise.to(**default))

    def sample_time(self, like: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draws training times ``[*B]``, in training steps, of the type and device of sequences ``[*B, H, d]``."""
        time = torch.randint(self.num_train_steps, like.shape[:-2], device=like.device, generator=generator)
        return time.to(like.dtype)

    def add_noise(self, sample: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Mixes the noisy sequence ``signal(t) x_0 + noise(t) eps``, ``[*B, H, d]``, at times ``[*B]``."""
        index = time.long()
        signal, amplitude = self.signal[index].to(time.dtype), self.noise[index].to(time.dtype)
        return signal[..., None, None] * sample + amplitude[..., None, None] * noise

    def target(self, sample: Tensor, noise: Tensor) -> Tensor:
        """What the network should predict of :meth:`add_noise`: the clean sequence or the noise."""
        return noise if self.prediction == "epsilon" else sample

    def noise_levels(self, num_steps: int) -> list[NoiseLevel]:
        """Lists the stops of a solver, one more than steps, evenly spaced from the noisiest level to no noise.

        Raises:
            ValueError: if the number of steps is out of range.
        """
        if not 1 <= num_steps <= self.num_train_steps:
            raise ValueError(f"num_steps must lie in 1..{self.num_train_steps} (num_train_steps), got {num_steps}")
        times = [round(self.num_train_steps * (num_steps - step) / num_steps) - 1 for step in range(num_steps)]
        return [*(NoiseLevel(float(time), *self._levels[time]) for time in times), NoiseLevel(0.0, 1.0, 0.0)]

    def split(
        self, output: Tensor, x: Tensor, level: NoiseLevel, prefix: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Splits noisy sequences ``x`` of a level into the clean ones and the noise that a network output stands for.

        All are ``[*B, H, d]``; ``prefix`` as for :meth:`solve`.
        """
        sample = output if self.prediction == "sample" else (x - output * level.noise) / level.signal
        if prefix is not None:
            sample = torch.cat([prefix, sample[..., prefix.shape[-2] :, :]], -2)
        elif self.prediction == "epsilon":
            return sample, output
        return sample, (x - sample * level.signal) / level.noise

    def solve(
        self,
        network: Callable[[Tensor, Tensor], Tensor],
        noise: Tensor,
        num_steps: int,
        solver: str = "dpm++2m",
        *,
        prefix: Tensor | None = None,
    ) -> Tensor:
        """Turns noise into sequences ``[*B, H, d]``.

        Args:
            network (callable): ``network(x [*B, H, d], time [*B]) -> [*B, H, d]``, its output read as ``prediction``.
            noise (Tensor): start noise ``[*B, H, d]``, standard normal.
            num_steps (int): number of solver steps.
            solver (str): a name in ``SOLVERS``. Defaults to ``"dpm++2m"``.

        Keyword Args:
            prefix (Tensor, optional): first frames ``[*B, k, d]`` that the clean sequence has to have: they replace
                what the network says at every step, so that the rest is made to fit them.

        Raises:
            ValueError: for an unknown solver or a number of steps out of range.
        """
        run, levels, batch = lookup(SOLVERS, solver, "solver"), self.noise_levels(num_steps), noise.shape[:-2]

        def denoise(x: Tensor, level: NoiseLevel) -> tuple[Tensor, Tensor]:
            return self.split(network(x, x.new_full(batch, level.time)), x, level, prefix)

        return run(denoise, noise, levels)
