# This source code is licensed under the MIT license found in the LICENSE file.
"""Harder observations of the same demonstrations: noise, wide redundant columns, distractors, small pictures.

A regime changes what is *observed*; motions and actions stay as they were recorded. All noise comes from a seed, and
the weights of an embedding from the regime alone: all seeds see the same sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.lookup import lookup

PICTURE = 32  # pixels along an edge


@dataclass(frozen=True)
class Regime:
    """A way to observe the robot.

    Args:
        name (str): what studies call it.
        title (str): what tables and pictures call it.
        embed (callable, optional): from standardised states ``[N, d]`` to what a sensor shows without noise ``[N, c]``.
            Default: the state itself.
        noise (float): white noise on every column, in typical (root mean square) steps of that column.
        distractors (int): coordinates beside the state that move by themselves (a slow random oscillation each) and
            are embedded with it.
        hidden (tuple of int): columns of the state that no sensor shows.

    Examples:
        >>> from torchrl_koap.data.regimes import REGIMES
        >>> REGIMES["noise"].noise, REGIMES["wide_64"].title
        (3.0, '64 nonlinear columns')
    """

    name: str
    title: str
    embed: Callable[[Tensor], Tensor] | None = None
    noise: float = 0.0
    distractors: int = 0
    hidden: tuple[int, ...] = ()


def apply_regime(data: TensorDictBase, regime: str | Regime, *, seed: int = 0) -> TensorDictBase:
    """The data as they are observed in a regime.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``state`` and ``episode``.
        regime (str or Regime): a name in :data:`REGIMES`, or a regime.

    Keyword Args:
        seed (int): of noise and distractors.

    Returns:
        TensorDictBase: the data with another ``state``; the rest is shared.

    Raises:
        ValueError: for an unknown regime, or a state that has no such columns to hide.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data.regimes import apply_regime
        >>> data = TensorDict({"state": torch.randn(50, 2).cumsum(0), "episode": torch.arange(50) // 25}, [50])
        >>> apply_regime(data, "wide_64")["state"].shape
        torch.Size([50, 64])
    """
    regime = lookup(REGIMES, regime, "regime") if isinstance(regime, str) else regime
    state, episode = data["state"], data["episode"]
    if regime.hidden and max(regime.hidden) >= state.shape[-1]:
        raise ValueError(f"regime {regime.name!r} hides column {max(regime.hidden)}, the state has {state.shape[-1]}")
    seen = state[:, [column for column in range(state.shape[-1]) if column not in regime.hidden]]
    generator = torch.Generator().manual_seed(1000 + seed)
    if regime.embed is not None:
        seen = (seen - seen.mean(0)) / seen.std(0).clamp_min(1e-9)
        if regime.distractors:
            seen = torch.cat([seen, _oscillations(episode, regime.distractors, generator).to(seen)], -1)
        seen = regime.embed(seen)
    if regime.noise:
        within = (episode[1:] == episode[:-1])[:, None]
        step = (torch.where(within, seen.diff(dim=0), 0.0).square().sum(0) / within.sum()).sqrt()
        seen = seen + regime.noise * step * torch.randn(seen.shape, generator=generator).to(seen)
    return data.copy().set("state", seen.to(state.dtype))


def _oscillations(episode: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Coordinates that oscillate at a period of 20 to 60 steps, each trajectory with its own phase and amplitude."""
    out = torch.empty(len(episode), count)
    for number in episode.unique():
        rows = episode == number
        time = torch.arange(int(rows.sum()))[:, None]
        period, phase, size = torch.rand(3, count, generator=generator)
        out[rows] = (0.5 + size) * torch.sin(2 * math.pi * (time / (20 + 40 * period) + phase))
    return out


def random_network(columns: int, gain: float, seed: int = 0) -> Callable[[Tensor], Tensor]:
    r"""A fixed random layer, :math:`\tanh(\gamma (W x / \sqrt{d} + b))` with standard normal ``W`` and ``b``.

    Args:
        columns (int): size of what it shows.
        gain (float): :math:`\gamma`, how nonlinear it is: at 1 a state two spreads out saturates some columns.
        seed (int): of its weights.
    """

    def embed(state: Tensor) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        weight = torch.randn(state.shape[-1], columns, generator=generator).to(state) / math.sqrt(state.shape[-1])
        return torch.tanh(gain * (state @ weight + torch.randn(columns, generator=generator).to(state)))

    return embed


def disc_picture(state: Tensor, *, pixels: int = PICTURE, radius: float = 2.5, kept: int = 64) -> Tensor:
    """A small picture of a bright disc at the first two coordinates, reduced to principal components of all pictures.

    Args:
        state (Tensor): standardised states ``[N, d]``.

    Keyword Args:
        pixels (int): pixels along an edge. Defaults to ``32``.
        radius (float): of the disc's soft edge, in pixels.
        kept (int): principal components.

    Returns:
        Tensor: ``[N, kept]``.
    """
    place = (pixels - 1) * (0.5 + state[:, :2] / 5)  # two and a half spreads to either side
    axis = torch.arange(pixels, device=state.device, dtype=state.dtype)
    profile = torch.exp(-0.5 * ((axis - place[..., None]) / radius) ** 2)  # [N, 2, pixels]
    picture = (profile[:, 1, :, None] * profile[:, 0, None, :]).flatten(1)
    centred = picture - picture.mean(0)
    components = torch.linalg.eigh(centred.mT @ centred)[1][:, -kept:].flip(-1)
    return centred @ components


REGIMES = {
    regime.name: regime
    for regime in (
        Regime("plain", "positions as recorded"),
        Regime("noise_1", "noise of one step", noise=1.0),
        Regime("noise", "noise of three steps", noise=3.0),
        Regime("wide_64", "64 nonlinear columns", random_network(64, 2.0), noise=2.0),
        Regime("wide_64_gain_1", "64 columns, weaker", random_network(64, 1.0), noise=2.0),
        Regime("wide_64_gain_4", "64 columns, stronger", random_network(64, 4.0), noise=2.0),
        Regime("wide_512", "512 nonlinear columns", random_network(512, 2.0), noise=2.0),
        Regime("pictures", "32 x 32 pictures", disc_picture, noise=1.0),
        Regime("distractors", "64 columns, 2 distractors", random_network(64, 1.0), noise=1.0, distractors=2),
    )
}
