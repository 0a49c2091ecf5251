# This source code is licensed under the MIT license found in the LICENSE file.
"""Solvers: from noise to a clean plan, step by step; pure functions in one dictionary.

Adding one is a function and a line in :data:`SOLVERS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from torch import Tensor


class Node(NamedTuple):
    """One stop of a solver: time in training steps, amplitude of the signal and of the noise there."""

    time: float
    signal: float
    noise: float


class Draws(Protocol):
    """Noise of a stochastic solver by step: a sequence of tensors, or something that draws when it is asked.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.solvers import Draws
        >>> draws: Draws = [torch.zeros(1, 12, 2), torch.ones(1, 12, 2)]  # two steps of a plan of 12 states
        >>> draws[1].shape
        torch.Size([1, 12, 2])
    """

    def __getitem__(self, index: int, /) -> Tensor:
        """Standard normal noise ``[*B, H, d]`` of step ``index``."""
        ...


Denoise = Callable[[Tensor, Node], tuple[Tensor, Tensor]]


def ddpm(denoise: Denoise, x: Tensor, nodes: Sequence[Node], draws: Draws) -> Tensor:
    """Ancestral sampling with the posterior's variance (Ho et al. 2020, eq. 7); step i adds ``draws[i]``.

    Args:
        denoise (callable): ``denoise(x, node)`` gives the clean sequence and the noise that the network sees in ``x``,
            both ``[*B, H, d]``.
        x (Tensor): start noise ``[*B, H, d]``.
        nodes (sequence of Node): stops from much noise to none, one more than steps.
        draws (Draws): standard normal noise ``[*B, H, d]``, one per step.

    Returns:
        Tensor: clean sequences ``[*B, H, d]``.
    """
    for index, (node, after) in enumerate(zip(nodes[:-1], nodes[1:], strict=True)):
        sample, _ = denoise(x, node)
        keep = (node.signal / after.signal) ** 2
        variance = node.noise**2
        x = sample * (after.signal * (1 - keep) / variance) + x * (keep**0.5 * after.noise**2 / variance)
        if after.noise > 0:
            x = x + draws[index] * max(after.noise**2 / variance * (1 - keep), 1e-20) ** 0.5
    return x


def ddim(denoise: Denoise, x: Tensor, nodes: Sequence[Node], draws: Draws) -> Tensor:
    """Deterministic implicit sampling (Song et al. 2021, eq. 12 with eta = 0).

    Args:
        denoise (callable): ``denoise(x, node)`` gives the clean sequence and the noise that the network sees in ``x``,
            both ``[*B, H, d]``.
        x (Tensor): start noise ``[*B, H, d]``.
        nodes (sequence of Node): stops from much noise to none, one more than steps.
        draws (Draws): not looked at: the solver is deterministic.

    Returns:
        Tensor: clean sequences ``[*B, H, d]``.
    """
    for node, after in zip(nodes[:-1], nodes[1:], strict=True):
        sample, epsilon = denoise(x, node)
        x = sample * after.signal + epsilon * after.noise
    return x


def dpm_solver_2m(denoise: Denoise, x: Tensor, nodes: Sequence[Node], draws: Draws) -> Tensor:
    """Second-order multistep solver in the log signal-to-noise ratio (Lu et al. 2022, algorithm 2).

    Args:
        denoise (callable): ``denoise(x, node)`` gives the clean sequence and the noise that the network sees in ``x``,
            both ``[*B, H, d]``.
        x (Tensor): start noise ``[*B, H, d]``.
        nodes (sequence of Node): stops from much noise to none, one more than steps.
        draws (Draws): not looked at: the solver is deterministic.

    Returns:
        Tensor: clean sequences ``[*B, H, d]``.
    """
    previous, previous_step = None, 0.0
    for node, after in zip(nodes[:-1], nodes[1:], strict=True):
        sample, _ = denoise(x, node)
        if after.noise == 0:
            return sample * after.signal
        step = math.log(after.signal / after.noise) - math.log(node.signal / node.noise)
        slope = sample
        if previous is not None:
            slope = sample + (sample - previous) * (0.5 * step / previous_step)
        x = x * (after.noise / node.noise) - slope * (after.signal * math.expm1(-step))
        previous, previous_step = sample, step
    return x


def euler(denoise: Denoise, x: Tensor, nodes: Sequence[Node], draws: Draws) -> Tensor:
    """Straight steps along the velocity ``eps - x_0``.

    Args:
        denoise (callable): ``denoise(x, node)`` gives the clean sequence and the noise that the network sees in ``x``,
            both ``[*B, H, d]``.
        x (Tensor): start noise ``[*B, H, d]``.
        nodes (sequence of Node): stops from much noise to none, one more than steps.
        draws (Draws): not looked at: the solver is deterministic.

    Returns:
        Tensor: clean sequences ``[*B, H, d]``.
    """
    for node, after in zip(nodes[:-1], nodes[1:], strict=True):
        sample, epsilon = denoise(x, node)
        x = x + (epsilon - sample) * (after.noise - node.noise)
    return x


def heun(denoise: Denoise, x: Tensor, nodes: Sequence[Node], draws: Draws) -> Tensor:
    """Trapezoidal steps: two network calls each, one in the last step (no velocity is defined at zero noise).

    Args:
        denoise (callable): ``denoise(x, node)`` gives the clean sequence and the noise that the network sees in ``x``,
            both ``[*B, H, d]``.
        x (Tensor): start noise ``[*B, H, d]``.
        nodes (sequence of Node): stops from much noise to none, one more than steps.
        draws (Draws): not looked at: the solver is deterministic.

    Returns:
        Tensor: clean sequences ``[*B, H, d]``.
    """
    for node, after in zip(nodes[:-1], nodes[1:], strict=True):
        sample, epsilon = denoise(x, node)
        velocity, step = epsilon - sample, after.noise - node.noise
        if after.noise > 0:
            sample, epsilon = denoise(x + velocity * step, after)
            velocity = (velocity + epsilon - sample) / 2
        x = x + velocity * step
    return x


class Solver(NamedTuple):
    """A solver function, the kind of path it walks, and whether it draws noise on the way."""

    run: Callable[[Denoise, Tensor, Sequence[Node], Draws], Tensor]
    path: str
    stochastic: bool = False


SOLVERS = {
    "ddpm": Solver(ddpm, path="diffusion", stochastic=True),
    "ddim": Solver(ddim, path="diffusion"),
    "dpm++2m": Solver(dpm_solver_2m, path="diffusion"),
    "euler": Solver(euler, path="flow"),
    "heun": Solver(heun, path="flow"),
}
