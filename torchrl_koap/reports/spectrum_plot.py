# This source code is licensed under the MIT license found in the LICENSE file.
"""The spectrum of an operator: eigenvalues in the complex plane, and their distances from the unit circle.

Inside, on and outside are told apart by one rule, the one that ``koap inspect`` prints:
:func:`~torchrl_koap.evaluation.latent_verdict.unit_circle_sides`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from torchrl_koap.evaluation.latent_verdict import ON_THE_CIRCLE, unit_circle_sides
from torchrl_koap.reports.style import BLUE, FAINT, INK, MUTED, ORANGE, PALE, PALE_BLUE, as_array, set_title, tidy

SIDES = {"inside": BLUE, "on": PALE_BLUE, "outside": ORANGE}
_TIMES = (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 20)


def as_spectrum(real: Any, imag: Any) -> np.ndarray:
    """Complex eigenvalues of their parts.

    Args:
        real (torch.Tensor or array): real parts [m].
        imag (torch.Tensor or array): imaginary parts [m].

    Raises:
        ValueError: if there is none, one is not finite, or the shapes differ.
    """
    real = as_array("real", real, [None]).astype(float)
    values = real + 1j * as_array("imag", imag, [len(real)]).astype(float)
    if not len(values) or not np.isfinite(values).all():
        raise ValueError(f"eigenvalues must be finite and at least one, got {len(values)} with NaN or infinite ones")
    return values


def draw_spectrum(axes: Axes, values: np.ndarray) -> None:
    """Eigenvalues in the complex plane; an inset magnifies them where they crowd.

    Args:
        axes (Axes): panel to fill.
        values (np.ndarray): complex eigenvalues [m].
    """
    angle = np.linspace(0, 2 * np.pi, 2000)
    side = np.array(unit_circle_sides(np.abs(values)))
    axes.fill(np.cos(angle), np.sin(angle), color=PALE, zorder=0)
    axes.axhline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    axes.axvline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    reach = 1.1 * min(max(1.0, float(np.abs(values).max())), 4.0)  # the title counts those beyond
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1, xlabel="real part", ylabel="imaginary part")
    if reach < 2:
        axes.set(xticks=(-1, -0.5, 0, 0.5, 1), yticks=(-1, -0.5, 0, 0.5, 1))
    panels = [axes]
    centre = np.array([values.real.min() + values.real.max(), values.imag.min() + values.imag.max()]) / 2
    spread = max(np.ptp(values.real), np.ptp(values.imag), 0.002)
    if spread < 0.4 and values.real.min() > 0.25:  # the empty half has room for a closer look
        inset = axes.inset_axes((0.17, 0.54, 0.36, 0.36))
        inset.set(xlim=centre[0] + 0.6 * spread * np.array([-1, 1]), ylim=centre[1] + 0.6 * spread * np.array([-1, 1]))
        inset.tick_params(labelsize=6.5, color=FAINT, labelcolor=MUTED)
        inset.locator_params(nbins=3)
        axes.indicate_inset_zoom(inset, edgecolor=MUTED)
        panels.append(inset)
    for panel in panels:
        panel.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=1, zorder=1)
        for name, color in SIDES.items():
            here = values[side == name]
            style = {"s": 20, "color": color, "alpha": 0.7, "linewidths": 0, "zorder": 2 + list(SIDES).index(name)}
            panel.scatter(here.real, here.imag, **style)
    counts = [f"{int((side == name).sum())} {name}" for name in SIDES]
    radius = f"{len(values)} eigenvalues, radius {np.abs(values).max():.5g}"
    set_title(axes, f"{radius}\n{', '.join(counts)} the unit circle")
    tidy(axes)


def draw_distances(axes: Axes, values: np.ndarray, *, control_hz: float | None = None) -> None:
    """Magnitudes minus 1 in order: linear within a thousandth of the circle, logarithmic beyond.

    Args:
        axes (Axes): panel to fill.
        values (np.ndarray): complex eigenvalues [m].

    Keyword Args:
        control_hz (float, optional): control steps per second; adds the time in which a mode fades to 1/e.
    """
    size = np.sort(np.abs(values))[::-1]
    side, ranks = np.array(unit_circle_sides(size)), np.arange(1, len(size) + 1)
    axes.set_yscale("symlog", linthresh=ON_THE_CIRCLE, linscale=0.6)
    axes.axhspan(-ON_THE_CIRCLE, ON_THE_CIRCLE, color=PALE, zorder=0)
    axes.axhline(0, color=MUTED, linewidth=1, zorder=1)
    for name, color in SIDES.items():
        here = side == name
        label = f"{name} the circle: {int(here.sum())}"
        axes.scatter(ranks[here], size[here] - 1, s=22, color=color, alpha=0.8, linewidths=0, zorder=2, label=label)
    low, high = min(size.min() - 1, -2 * ON_THE_CIRCLE), max(size.max() - 1, 2 * ON_THE_CIRCLE)
    axes.set_ylim(1.6 * low, 1.6 * high)
    bottom, top = axes.get_ylim()
    near = max(-low, high) < 20 * ON_THE_CIRCLE  # within two per cent: decades alone would be one tick
    steps = (1, 2, 5) if near else (1,)
    ticks = [sign * step * 10.0**power for sign in (-1, 1) for step in steps for power in range(-3, 4)]
    ticks = sorted(tick for tick in [*ticks, 0.0] if bottom <= tick <= top)
    axes.set_yticks(ticks, [f"{tick:+g}" if tick else "0" for tick in ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("rank")
    axes.set_ylabel("magnitude - 1")
    set_title(axes, "distance from the unit circle\n(shaded: counted as on it)")
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    tidy(axes)
    if control_hz is not None:
        places = {math.exp(-1 / (time * control_hz)) - 1: f"{time:g} s" for time in _TIMES}
        places = {place: text for place, text in places.items() if bottom < place < -ON_THE_CIRCLE}
        fades = axes.secondary_yaxis("right")
        fades.set_yticks(list(places), list(places.values()))
        fades.yaxis.set_minor_locator(NullLocator())
        fades.tick_params(labelsize=8, color=FAINT, labelcolor=MUTED)
        fades.set_ylabel("fades to 1/e within", size=9, color=INK)
        fades.spines["right"].set_visible(False)
