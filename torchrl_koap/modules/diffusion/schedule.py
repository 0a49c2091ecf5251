# This source code is licensed under the MIT license found in the LICENSE file.
r"""Noise schedules and solvers of the planner's generative model.

Every schedule is one line of ``SCHEDULES``, every solver one line of ``SOLVERS``. A noisy plan at time ``t`` is

    x_t = signal(t) x_0 + noise(t) eps,    eps ~ N(0, I)

with ``signal^2 + noise^2 = 1`` on a *diffusion* path and ``signal + noise = 1`` on a *flow* path. Time is measured in
training steps: integers ``0 .. N-1`` on a diffusion path, real numbers ``0 < t <= N`` on a flow path. Solvers walk
from much noise to none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.diffusion.solvers import SOLVERS, Draws, Node

Network = Callable[[Tensor, Tensor], Tensor]


def squared_cosine(num_train_steps: int) -> Tensor:
    """Signal variance after each step, nearly a squared cosine (Nichol and Dhariwal 2021)."""
    edges = torch.arange(num_train_steps + 1, dtype=torch.float64) / num_train_steps
    kept = torch.cos((edges + 0.008) / 1.008 * math.pi / 2).square()
    return (kept[1:] / kept[:-1]).clamp_min(1e-3).cumprod(0)


def linear(num_train_steps: int) -> Tensor:
    """Signal variance if the added one grows linearly (Ho et al. 2020), rescaled so that any number ends in noise."""
    stretch = 1000 / num_train_steps
    added = torch.linspace(1e-4 * stretch, 0.02 * stretch, num_train_steps, dtype=torch.float64).clamp_max(0.999)
    return (1 - added).cumprod(0)


def flow(num_train_steps: int) -> Tensor:
    """Signal *amplitude* of the straight path from data (step 0) to noise (step N) (Lipman et al. 2023)."""
    return 1 - torch.arange(num_train_steps + 1, dtype=torch.float64) / num_train_steps


class Schedule(NamedTuple):
    """A schedule function and the kind of path it describes."""

    signal: Callable[[int], Tensor]
    path: str


SCHEDULES = {
    "squared_cosine": Schedule(squared_cosine, path="diffusion"),
    "linear": Schedule(linear, path="diffusion"),
    "flow": Schedule(flow, path="flow"),
}

PREDICTIONS = ("epsilon", "sample", "velocity")


class NoiseSchedule(nn.Module):
    """Adds noise to plans, says what the network has to predict, and removes noise again.

    What the network predicts (``prediction``): ``"epsilon"`` the noise, ``"sample"`` the clean plan, ``"velocity"``
    the derivative along the path (``signal eps - noise x_0`` on a diffusion path, Salimans and Ho 2022; ``eps - x_0``
    on a flow path).

    Args:
        schedule (str): a name in ``SCHEDULES``. Defaults to ``"squared_cosine"``.
        prediction (str): ``"epsilon"``, ``"sample"`` or ``"velocity"``. Defaults to ``"velocity"`` on a flow path,
            else to ``"epsilon"``.
        num_train_steps (int): number ``N`` of noise levels in training. Defaults to 50 as in KOAP's first public code.

    Raises:
        ValueError: for an unknown schedule or prediction (the nearest name is suggested), and for ``"epsilon"`` on a
            flow path, whose start holds no signal, so that the plan cannot be computed from the noise.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.schedule import NoiseSchedule
        >>> schedule = NoiseSchedule("flow", num_train_steps=1000)
        >>> plan, noise = torch.ones(3, 14, 2), torch.randn(3, 14, 2)
        >>> solved = schedule.solve(lambda x, time: noise - plan, noise, num_steps=4, solver="euler")
        >>> torch.allclose(solved, plan, atol=1e-5)
        True
    """

    def __init__(self, schedule: str = "squared_cosine", prediction: str | None = None, num_train_steps: int = 50):
        super().__init__()
        kind = lookup(SCHEDULES, schedule, "schedule")
        if prediction is None:
            prediction = "velocity" if kind.path == "flow" else "epsilon"
        lookup(PREDICTIONS, prediction, "prediction")
        if kind.path == "flow" and prediction == "epsilon":
            raise ValueError(
                "prediction 'epsilon' does not fit schedule 'flow' (no signal at its start); use 'velocity'"
            )
        if num_train_steps < 1:
            raise ValueError(f"num_train_steps must be at least 1, got {num_train_steps}")
        self.schedule, self.path, self.prediction = schedule, kind.path, prediction
        self.num_train_steps = num_train_steps
        with torch.device("cpu"):  # the numbers are read below, also where modules are built without storage
            table = kind.signal(num_train_steps)
        signal, noise = (table, 1 - table) if self.path == "flow" else (table.sqrt(), (1 - table).sqrt())
        # Solvers read numbers from here: exact in every dtype, no device synchronisation, constants for torch.compile.
        self._levels = tuple(zip(signal.tolist(), noise.tolist(), strict=True))
        default = {"dtype": torch.get_default_dtype(), "device": torch.get_default_device()}
        self.register_buffer("signal", signal.to(**default))
        self.register_buffer("noise", noise.to(**default))

    def extra_repr(self) -> str:
        """Shows the options in ``print(schedule)``."""
        return f"schedule={self.schedule!r}, prediction={self.prediction!r}, num_train_steps={self.num_train_steps}"

    def sample_time(self, like: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draws training times.

        Args:
            like (Tensor): sequences ``[*B, H, d]``, for shape, type and device.
            generator (torch.Generator, optional): source of the numbers.

        Returns:
            Tensor: ``[*B]`` in training steps.
        """
        shape, options = like.shape[:-2], {"device": like.device, "generator": generator}
        if self.path == "flow":
            return (1 - torch.rand(shape, dtype=like.dtype, **options)) * self.num_train_steps  # never exactly zero
        return torch.randint(self.num_train_steps, shape, **options).to(like.dtype)

    def levels(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Amplitudes of signal and noise at ``time`` ``[*B]`` (training steps), each ``[*B]``."""
        if self.path == "flow":
            noise = time / self.num_train_steps
            return 1 - noise, noise
        index = time.long()
        return self.signal[index].to(time.dtype), self.noise[index].to(time.dtype)

    def add_noise(self, sample: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """The noisy plan ``signal(t) x_0 + noise(t) eps``.

        Args:
            sample (Tensor): clean plans ``x_0``, ``[*B, H, d]``.
            noise (Tensor): noise ``eps``, ``[*B, H, d]``.
            time (Tensor): ``[*B]`` in training steps.

        Returns:
            Tensor: ``[*B, H, d]``.
        """
        signal, amplitude = self.levels(time)
        return signal[..., None, None] * sample + amplitude[..., None, None] * noise

    def target(self, sample: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """What the network should predict: the noise, the clean plan or the velocity.

        Args:
            sample (Tensor): clean plans ``x_0``, ``[*B, H, d]``.
            noise (Tensor): noise ``eps``, ``[*B, H, d]``.
            time (Tensor): ``[*B]`` in training steps.

        Returns:
            Tensor: ``[*B, H, d]``.
        """
        if self.prediction == "epsilon":
            return noise
        if self.prediction == "sample":
            return sample
        if self.path == "flow":
            return noise - sample
        signal, amplitude = self.levels(time)
        return signal[..., None, None] * noise - amplitude[..., None, None] * sample

    def nodes(self, num_steps: int, times: Sequence[float] | None = None) -> list[Node]:
        """Stops of a solver from the noisiest level to the clean plan, evenly spaced in time (``num_steps + 1`` nodes).

        Args:
            num_steps (int): number of solver steps, at most ``num_train_steps`` on a diffusion path.
            times (sequence of float, optional): decreasing times to stop at instead; the clean plan is appended.

        Returns:
            list of Node: time in training steps, amplitudes of signal and noise.

        Raises:
            ValueError: if the number of steps is out of range.
        """
        if times is None:
            if num_steps < 1 or (self.path == "diffusion" and num_steps > self.num_train_steps):
                raise ValueError(f"num_steps must lie in 1..{self.num_train_steps} (num_train_steps), got {num_steps}")
            times = [self.num_train_steps * (num_steps - step) / num_steps for step in range(num_steps)]
            if self.path == "diffusion":
                times = [round(time) - 1 for time in times]
        if self.path == "flow":
            stops = [Node(time, 1 - time / self.num_train_steps, time / self.num_train_steps) for time in times]
        else:
            stops = [Node(float(time), *self._levels[int(time)]) for time in times]
        return [*stops, Node(0.0, 1.0, 0.0)]

    def split(
        self, output: Tensor, x: Tensor, node: Node, clip: float | None = None, known: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Clean plan and noise that a network output stands for.

        Args:
            output (Tensor): of the network, ``[*B, H, d]``.
            x (Tensor): the noisy plan it was asked about, ``[*B, H, d]``.
            node (Node): level of its noise.
            clip (float, optional): the clean plan is clipped to ``[-clip, clip]``.
            known (Tensor, optional): first frames ``[*B, k, d]`` of the clean plan.
        """
        if self.prediction == "epsilon":
            sample = (x - output * node.noise) / node.signal
        elif self.prediction == "sample":
            sample = output
        elif self.path == "flow":
            sample = x - output * node.noise
        else:
            sample = x * node.signal - output * node.noise
        if clip is not None:
            sample = sample.clamp(-clip, clip)
        if known is not None:
            sample = torch.cat([known, sample[..., known.shape[-2] :, :]], -2)
        elif clip is None and self.prediction == "epsilon":
            return sample, output
        return sample, (x - sample * node.signal) / node.noise

    def solve(
        self,
        network: Network,
        noise: Tensor,
        num_steps: int,
        solver: str = "ddim",
        *,
        clip: float | None = None,
        step_noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        times: Sequence[float] | None = None,
        known: Tensor | None = None,
    ) -> Tensor:
        """Turns noise into plans.

        Args:
            network (callable): ``network(x [*B, H, d], time [*B]) -> [*B, H, d]``, its output read as ``prediction``.
            noise (Tensor): start noise ``[*B, H, d]``, standard normal.
            num_steps (int): number of solver steps.
            solver (str): a name in ``SOLVERS`` that fits the schedule's path.

        Keyword Args:
            clip (float, optional): the clean plan is clipped to ``[-clip, clip]`` at every step. Defaults to no
                clipping.
            step_noise (Tensor, optional): the draws of a stochastic solver, ``[num_steps, *B, H, d]``.
            generator (torch.Generator, optional): source of those draws if ``step_noise`` is not given.
            times (sequence of float, optional): own stops instead of ``num_steps`` even ones.
            known (Tensor, optional): first frames ``[*B, k, d]`` that the clean plan has to have: they take the place
                of what the network says at every step, so that the rest is made to fit them.

        Raises:
            ValueError: for an unknown solver, one of the other path, or a number of steps out of range.
        """
        self.check_solver(solver)
        nodes = self.nodes(num_steps, times)
        draws: Draws = ()
        if SOLVERS[solver].stochastic:
            draws = step_noise if step_noise is not None else _Draws(noise, generator)
        batch = noise.shape[:-2]

        def denoise(x: Tensor, node: Node) -> tuple[Tensor, Tensor]:
            return self.split(network(x, x.new_full(batch, node.time)), x, node, clip, known)

        return SOLVERS[solver].run(denoise, noise, nodes, draws)

    def check_solver(self, solver: str) -> None:
        """Raises a ``ValueError`` if the solver is unknown or walks the other kind of path."""
        kind = lookup(SOLVERS, solver, "solver")
        if kind.path != self.path:
            fitting = ", ".join(repr(name) for name, other in SOLVERS.items() if other.path == self.path)
            raise ValueError(
                f"solver {solver!r} walks a {kind.path} path, but schedule {self.schedule!r} is a {self.path} path;"
                f" solvers that fit: {fitting}"
            )


class _Draws:
    """Fresh standard normal noise at every index."""

    def __init__(self, like: Tensor, generator: torch.Generator | None):
        self.like, self.generator = like, generator

    def __getitem__(self, index: int) -> Tensor:
        like = self.like
        return torch.randn(like.shape, dtype=like.dtype, device=like.device, generator=self.generator)
