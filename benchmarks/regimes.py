# This source code is licensed under the MIT license found in the LICENSE file.
"""Defines harder observations of demonstrations: noise, many redundant columns, distractors, small pictures.

A regime changes the *observation*; motions and actions stay as recorded. Noise depends on the seed. The weights of an
embedding depend on the regime alone, so that all seeds have the same sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

PICTURE, RADIUS = 32, 2.5  # edge of a picture and radius of the disc's soft edge, in pixels
COMPONENTS = 64  # observed principal components of pictures


@dataclass(frozen=True)
class Regime:
    """An observation model of the robot.

    Args:
        name (str): name in the tables of results.
        embed (callable, optional): from standardised states ``[N, d]`` to observations without noise ``[N, c]``.
            Default: the identity.
        fit (callable, optional): from recorded standardised states to an ``embed`` that depends on them.
        noise (float): white noise on every column, in typical (root mean square) steps of that column.
        distractors (int): coordinates independent of the robot, each a slow random oscillation, that are embedded
            together with the state.
        hidden (tuple of int): columns of the state that are not observed.
    """

    name: str
    embed: Callable[[Tensor], Tensor] | None = None
    fit: Callable[[Tensor], Callable[[Tensor], Tensor]] | None = None
    noise: float = 0.0
    distractors: int = 0
    hidden: tuple[int, ...] = ()


class RegimeSensor:
    """Observes states as a regime defines; it is fitted to recorded data and also observes states of rollouts.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``state`` and ``episode``, which determine the scales.
        regime (Regime): the observation model.

    Keyword Args:
        seed (int): seed of noise and distractors.

    Attributes:
        recorded (Tensor): observations of the data without noise ``[N, c]``.
        distractors (Tensor, optional): distractors at each step of the data ``[N, k]``.
        step (Tensor): typical step of every column ``[c]``, the unit of the noise.

    Raises:
        ValueError: for a state without the columns to hide.
    """

    def __init__(self, data: TensorDictBase, regime: Regime, *, seed: int = 0):
        self.regime = regime
        state, episode, hidden = data["state"], data["episode"], regime.hidden
        if hidden and max(hidden) >= state.shape[-1]:
            raise ValueError(f"regime {self.regime.name!r} hides column {max(hidden)}, the state has {state.shape[-1]}")
        self._generator = torch.Generator().manual_seed(1000 + seed)
        self._columns = [column for column in range(state.shape[-1]) if column not in hidden]
        self._mean = state[:, self._columns].mean(0)
        self._spread = state[:, self._columns].std(0).clamp_min(1e-9)
        self.distractors = None
        if self.regime.distractors:
            self.distractors = _oscillations(episode, self.regime.distractors, self._generator).to(state)
        self._embed = self.regime.embed
        if self.regime.fit is not None:
            self._embed = self.regime.fit(self._standardised(state, self.distractors))
        self.recorded = self.show(state, self.distractors)
        within = (episode[1:] == episode[:-1])[:, None]
        moved = torch.where(within, self.recorded.diff(dim=0), 0.0)
        self.step = (moved.square().sum(0) / within.sum()).sqrt()

    def show(self, state: Tensor, distractors: Tensor | None = None) -> Tensor:
        """Returns observations without noise ``[N, c]``.

        Args:
            state (Tensor): states ``[N, d]``.
            distractors (Tensor, optional): distractors at these states ``[N, k]``.

        Raises:
            ValueError: if the regime has distractors and none are given.
        """
        if self._embed is None:
            return state[:, self._columns]
        if self.regime.distractors and distractors is None:
            raise ValueError(
                f"regime {self.regime.name!r} shows {self.regime.distractors} distractors beside the state"
            )
        return self._embed(self._standardised(state, distractors))

    def _standardised(self, state: Tensor, distractors: Tensor | None) -> Tensor:
        seen = (state[:, self._columns] - self._mean) / self._spread
        return seen if distractors is None else torch.cat([seen, distractors], -1)

    def noisy(self, shown: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Adds noise to observations, drawn anew at every call.

        Args:
            shown (Tensor): from :meth:`show` ``[N, c]``.
            generator (torch.Generator, optional): source of the noise, so that it does not depend on earlier draws.
                Default: the sensor's own generator.
        """
        if not self.regime.noise:
            return shown
        noise = torch.randn(shown.shape, generator=generator or self._generator).to(shown)
        return shown + self.regime.noise * self.step * noise


def _oscillations(episode: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draws oscillations with a period of 20 to 60 steps; phase and amplitude differ between trajectories."""
    episode = episode.cpu()  # the draw is then the same for every device
    out = torch.empty(len(episode), count)
    for number in episode.unique():
        rows = episode == number
        time = torch.arange(int(rows.sum()))[:, None]
        period, phase, size = torch.rand(3, count, generator=generator)
        out[rows] = (0.5 + size) * torch.sin(2 * math.pi * (time / (20 + 40 * period) + phase))
    return out


def random_network(columns: int, gain: float) -> Callable[[Tensor], Tensor]:
    r"""Returns a fixed random layer, :math:`\tanh(\gamma (W x / \sqrt{d} + b))` with standard normal ``W`` and ``b``.

    Args:
        columns (int): number of output columns.
        gain (float): nonlinearity :math:`\gamma`: at 1 a state two standard deviations out saturates some columns.
    """

    def embed(state: Tensor) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        weight = torch.randn(state.shape[-1], columns, generator=generator).to(state) / math.sqrt(state.shape[-1])
        return torch.tanh(gain * (state @ weight + torch.randn(columns, generator=generator).to(state)))

    return embed


def disc_pictures(recorded: Tensor) -> Callable[[Tensor], Tensor]:
    """Draws small pictures of a disc at the first two coordinates; returns a map to their principal components.

    Args:
        recorded (Tensor): standardised states ``[N, d]``.

    Returns:
        callable: from standardised states ``[N, d]`` to the components of their pictures ``[N, COMPONENTS]``.
    """

    def draw(state: Tensor) -> Tensor:
        place = (PICTURE - 1) * (0.5 + state[:, :2] / 5)  # the picture spans 2.5 standard deviations to either side
        axis = torch.arange(PICTURE, device=state.device, dtype=state.dtype)
        profile = torch.exp(-0.5 * ((axis - place[..., None]) / RADIUS) ** 2)  # [N, 2, PICTURE]
        return (profile[:, 1, :, None] * profile[:, 0, None, :]).flatten(1)

    pictures = draw(recorded)
    mean = pictures.mean(0)
    centred = pictures - mean
    components = torch.linalg.eigh(centred.mT @ centred)[1][:, -COMPONENTS:].flip(-1)
    return lambda state: (draw(state) - mean) @ components


REGIMES = {
    regime.name: regime
    for regime in (
        Regime("plain"),
        Regime("noise", noise=3.0),
        Regime("wide_64", random_network(64, 2.0), noise=2.0),
        Regime("wide_512", random_network(512, 2.0), noise=2.0),
        Regime("pictures", fit=disc_pictures, noise=1.0),
        Regime("distractors", random_network(64, 1.0), noise=1.0, distractors=2),
    )
}
