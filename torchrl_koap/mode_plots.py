# This source code is licensed under the MIT license found in the LICENSE file.
"""Which modes occurred: a picture, and what to compare their entropy with."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_koap.metrics import mode_entropy
from torchrl_koap.plot_scenes import INK, mode_choices, mode_colors, set_title, tidy
from torchrl_koap.plots import as_array, save_figure


def even_entropy(episodes: int, num_modes: int) -> float:
    """Expected :func:`~torchrl_koap.metrics.mode_entropy` of that many episodes whose modes are drawn evenly.

    A few episodes cannot fill all modes evenly, so this is below 1: what a policy without preferences scores on
    average. It is the exact mean over the binomial counts.

    Examples:
        >>> from torchrl_koap.mode_plots import even_entropy
        >>> even_entropy(1, 24), round(even_entropy(60, 24), 3), round(even_entropy(10_000, 24), 3)
        (0.0, 0.932, 1.0)
    """
    if episodes < 1 or num_modes < 2:
        return 0.0
    total = 0.0
    for count in range(1, episodes + 1):
        log_chance = math.lgamma(episodes + 1) - math.lgamma(count + 1) - math.lgamma(episodes - count + 1)
        log_chance += count * math.log(1 / num_modes) + (episodes - count) * math.log(1 - 1 / num_modes)
        total -= math.exp(log_chance) * count / episodes * math.log(count / episodes)
    return num_modes * total / math.log(num_modes)


def plot_modes(
    mode: Any,
    path: str | Path,
    *,
    task: str | None = "avoiding",
    num_modes: int | None = None,
    reference: Any = None,
) -> Path:
    """How often each mode occurred, with the entropy of the distribution.

    Args:
        mode (torch.Tensor or array): modes of the *successful* rollouts [n]; -1 (no mode) is counted in the title.
        path (str or Path): png to write.
        task (str, optional): task whose choices order and colour the bars.
        num_modes (int, optional): number of modes, needed where the task names no choices.
        reference (torch.Tensor or array, optional): modes of the demonstrations; drawn as ticks, scaled to the number
            of rollouts.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.mode_plots import plot_modes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_modes([0, 5, 5, 23], f"{folder}/modes.png").name
        'modes.png'
    """
    mode = as_array("mode", mode, [None]).astype(int)
    choices = mode_choices(task, num_modes)
    colors = mode_colors(task, num_modes)
    number = len(colors)
    mode, lost = mode[(mode >= 0) & (mode < number)], int(((mode < 0) | (mode >= number)).sum())
    counts = np.bincount(mode, minlength=number)
    last = len(choices[-1][1])
    places = np.arange(number) + 0.7 * (np.arange(number) // last) if len(choices) > 1 else np.arange(number) * 1.0

    figure = Figure(figsize=(8.4, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(places, counts, width=0.86, color=colors, zorder=2)
    if reference is not None:
        reference = as_array("reference", reference, [None]).astype(int)
        reference = reference[(reference >= 0) & (reference < number)]
        if len(reference):
            level = np.bincount(reference, minlength=number) * len(mode) / len(reference)
            label = f"{len(reference)} demonstrations, scaled"
            axes.hlines(level, places - 0.46, places + 0.46, color=INK, linewidth=1.3, zorder=3, label=label)
            axes.legend(frameon=False, fontsize=8, loc="upper right", borderpad=0)
    axes.set_ylabel("successful rollouts")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylim(0, 1.2 * max(1, axes.dataLim.y1))
    axes.set_xlim(places[0] - 0.8, places[-1] + 0.8)
    if len(choices) > 1:
        axes.set_xticks(places, [name.split()[-1] for name in choices[-1][1]] * (number // last))
        for group in range(number // last):
            middle = places[group * last : (group + 1) * last].mean()
            words, rest = [], group
            for _, names in reversed(choices[:-1]):
                rest, digit = divmod(rest, len(names))
                words.append(names[digit])
            text = " / ".join(reversed(words))
            axes.annotate(text, (middle, 0), (0, -22), textcoords="offset points", ha="center", size=8.5, color=INK)
        axes.set_xlabel(" / ".join(name for name, _ in choices[:-1]) + f", and above it {choices[-1][0]}", labelpad=19)
    else:
        axes.set_xlabel(choices[0][0])
    occurred = f"{int((counts > 0).sum())} of {number} modes, entropy {mode_entropy(mode.tolist(), number):.2f}"
    even = f"; an even choice gives {even_entropy(len(mode), number):.2f} on average at n = {len(mode)}"
    set_title(axes, occurred + (even if len(mode) else "") + (f"; {lost} without a mode" if lost else ""))
    tidy(axes)
    axes.tick_params(axis="x", length=0)
    return save_figure(figure, path)
