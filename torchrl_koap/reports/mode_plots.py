# This source code is licensed under the MIT license found in the LICENSE file.
"""Which modes occurred: a chart, and a colour for each mode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import hsv_to_rgb, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from safetensors.numpy import load_file

from torchrl_koap.evaluation.statistics import expected_entropy, mode_entropy
from torchrl_koap.lookup import resolve
from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import BLUE, GREY, INK, SUCCESS, entry, put_legend, tidy
from torchrl_koap.tasks import Modes

_LISTED = 10  # modes of a single choice that have wide bars with their names below


@picture(
    "modes.png",
    source="rollouts.safetensors",
    title="Modes of the successful rollouts",
    caption="One bar per mode, in the colour of its rollouts. Black ticks: the share of each mode in the"
    " demonstrations, where they say which they took. Entropy is 1 when all modes are equally frequent; a handful of"
    " rollouts cannot reach 1 even with a uniform choice, the title says what to expect.",
    order=40,
)
def draw_modes(rollouts: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws how often each ``mode`` ``[E]`` occurred among the successes, with the entropy of the distribution.

    The title counts those without one (-1); modes of the demonstrations are ticks, scaled to the number of rollouts.
    """
    modes, number = run.modes, run.modes.number
    if number < 2:
        raise NothingToDraw("there is no choice")
    mode = entry(rollouts, "mode", [None]).astype(int)
    mode = mode[entry(rollouts, "outcome", [len(mode)]) == SUCCESS]
    lost = int(((mode < 0) | (mode >= number)).sum())
    mode = mode[(mode >= 0) & (mode < number)]
    counts = np.bincount(mode, minlength=number)
    *heads, (last, names) = modes.choices
    places = np.arange(number) + (0.7 * (np.arange(number) // len(names)) if heads else 0.0)

    few = not heads and number <= _LISTED
    figure = Figure(figsize=(max(5.6, 0.85 * number + 1.2) if few else 8.4, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(places, counts, width=0.86, color=mode_colors(modes), zorder=2)
    reference = recorded_modes(run.folder / "demonstrations.safetensors", modes)
    if len(reference):
        level = np.bincount(reference, minlength=number) * len(mode) / len(reference)
        label = f"{len(reference)} demonstrations, scaled"
        axes.hlines(level, places - 0.46, places + 0.46, color=INK, linewidth=1.3, zorder=3, label=label)
        put_legend(axes)
    axes.set_ylabel("successful rollouts")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylim(0, 1.2 * max(1, axes.dataLim.y1))
    axes.set_xlim(places[0] - 0.8, places[-1] + 0.8)
    if heads:
        axes.set_xticks(places, [name.split()[-1] for name in names] * (number // len(names)))
        for group in range(number // len(names)):
            middle = places[group * len(names) : (group + 1) * len(names)].mean()
            text = Modes(modes.choices[:-1]).name_of(group).replace(", ", " / ")  # of all choices but the last
            axes.annotate(text, (middle, 0), (0, -22), textcoords="offset points", ha="center", size=8.5, color=INK)
        axes.set_xlabel(" / ".join(name for name, _ in heads) + f", and above it {last}", labelpad=19)
    else:
        axes.set_xticks(places, [name.replace(", ", "\n") for name in names])
        axes.set_xlabel(last)
    occurred = f"{int((counts > 0).sum())} of {number} modes, entropy {mode_entropy(mode.tolist(), number):.2f}"
    uniform = f"a uniform choice gives {expected_entropy(len(mode), number):.2f} on average at n = {len(mode)}"
    parts = [occurred] + [uniform] * bool(len(mode)) + [f"{lost} without a mode"] * bool(lost)
    tidy(axes, ";\n".join((parts[0], "; ".join(parts[1:]))) if few and parts[1:] else "; ".join(parts))
    axes.tick_params(axis="x", length=0)
    return figure


def recorded_modes(demonstrations: Path, modes: Modes) -> np.ndarray:
    """Returns the modes of the demonstrations that are decided; none where paths do not tell them.

    The file holds ``mode`` ``[episodes]``, or ``position`` ``[N, 2]`` (m) and ``episode`` ``[N]``.
    """
    data = load_file(demonstrations) if demonstrations.exists() else {}
    found = entry(data, "mode", [None]).astype(int) if "mode" in data else np.zeros(0, int)
    mode_of_path = resolve(modes.of_path, "of_path of the modes")
    if "mode" not in data and mode_of_path is not None and "position" in data:
        position = entry(data, "position", [None, 2])
        episode = entry(data, "episode", [len(position)])
        paths = np.split(position, np.flatnonzero(np.diff(episode) != 0) + 1)
        found = np.array([mode_of_path(path) for path in paths], int)
    return found[(found >= 0) & (found < modes.number)]


def mode_colors(modes: Modes) -> np.ndarray:
    """Returns an sRGB colour in 0..1 for each mode: hue tells the last choice apart, lightness all before it."""
    if modes.number < 2:
        return np.array([to_rgb(BLUE)])
    hues = len(modes.choices[-1][1])
    shades = modes.number // hues
    hue = np.tile((0.6 - np.arange(hues) * min(0.27, 1 / hues)) % 1, shades)
    if shades > 1:
        lightness = np.repeat(np.linspace(0.42, 1.3, shades), hues)
    else:  # neighbours among many hues need another lightness too
        lightness = np.where(np.arange(hues) % 2, 0.8 if hues <= 8 else 1.15, 0.8)
    pure = hsv_to_rgb(np.stack([hue, np.full_like(hue, 0.8), np.minimum(lightness, 0.95)], 1))
    return 1 - (1 - pure) * np.clip(2 - lightness, 0, 1)[:, None]


def color_of_mode(mode: int, colors: np.ndarray) -> Any:
    """Returns the colour of a mode, grey for -1: it is not decided."""
    return colors[mode] if 0 <= mode < len(colors) else GREY
