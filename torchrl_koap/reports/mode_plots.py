# This source code is licensed under the MIT license found in the LICENSE file.
"""Which modes occurred: a chart, a table for other pictures, and what to compare their entropy with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from safetensors.numpy import load_file

from torchrl_koap.evaluation.statistics import mode_entropy
from torchrl_koap.reports.mode_colors import initials, mode_colors
from torchrl_koap.reports.pictures import picture
from torchrl_koap.reports.style import FAINT, INK, MUTED, SUCCESS, as_array, legend_beside, save_figure, set_title, tidy
from torchrl_koap.tasks.avoiding import OBSTACLES
from torchrl_koap.tasks.modes import mode_choices

_ROW_REACH = 0.03  # m before and behind a row of cylinders: the gap is the one at the first frame within it


def even_entropy(episodes: int, num_modes: int) -> float:
    """Expected mode entropy of that many episodes whose modes are drawn evenly.

    A few episodes cannot fill all modes evenly, so this is below 1: what a policy without preferences scores on
    average. It is the exact mean over the binomial counts.

    Args:
        episodes (int): number of episodes.
        num_modes (int): number of modes, and base of the logarithm.

    Returns:
        float: 0 to 1.

    Examples:
        >>> from torchrl_koap.reports.mode_plots import even_entropy
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


@picture(
    "modes.png",
    source="rollouts.safetensors",
    title="Modes of the successful rollouts",
    caption="One bar per mode. Black ticks: the share of each mode in the demonstrations, where they say which they"
    " took. Entropy is 1 when all modes are equally frequent; a handful of rollouts cannot reach 1 even with an even"
    " choice, the title says what to expect.",
    place=40,
)
def _draw_modes(rollouts: Mapping[str, Any], path: Path, *, task: str | None, num_modes: int, run_dir: Path) -> Path:
    demonstrations = run_dir / "demonstrations.safetensors"
    reference = recorded_modes(load_file(demonstrations), task) if demonstrations.exists() else None
    mode = rollouts["mode"][rollouts["outcome"] == SUCCESS]
    return plot_modes(mode, path, task=task, num_modes=num_modes, reference=reference)


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
        reference (torch.Tensor or array, optional): modes of the demonstrations; drawn as black ticks, scaled to the
            number of rollouts.

    Raises:
        ValueError: if a shape is wrong, or the task names no modes and their number is not given.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.mode_plots import plot_modes
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

    few = len(choices) == 1 and number <= 10
    figure = Figure(figsize=(max(5.6, 0.85 * number + 1.2) if few else 8.4, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(places, counts, width=0.86, color=colors, zorder=2)
    if reference is not None:
        reference = as_array("reference", reference, [None]).astype(int)
        reference = reference[(reference >= 0) & (reference < number)]
        if len(reference):
            level = np.bincount(reference, minlength=number) * len(mode) / len(reference)
            label = f"{len(reference)} demonstrations, scaled"
            axes.hlines(level, places - 0.46, places + 0.46, color=INK, linewidth=1.3, zorder=3, label=label)
            legend_beside(axes)
    axes.set_ylabel("successful rollouts")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylim(0, 1.2 * max(1, axes.dataLim.y1))
    axes.set_xlim(places[0] - 0.8, places[-1] + 0.8)
    if len(choices) > 1:
        axes.set_xticks(places, [name.split()[-1] for name in choices[-1][1]] * (number // last))
        for group in range(number // last):
            middle = places[group * last : (group + 1) * last].mean()
            text = " / ".join(_words(group, choices[:-1]))
            axes.annotate(text, (middle, 0), (0, -22), textcoords="offset points", ha="center", size=8.5, color=INK)
        axes.set_xlabel(" / ".join(name for name, _ in choices[:-1]) + f", and above it {choices[-1][0]}", labelpad=19)
    else:
        axes.set_xticks(places, [name.replace(", ", "\n") for name in choices[0][1]])
        axes.set_xlabel(choices[0][0])
    occurred = f"{int((counts > 0).sum())} of {number} modes, entropy {mode_entropy(mode.tolist(), number):.2f}"
    even = f"an even choice gives {even_entropy(len(mode), number):.2f} on average at n = {len(mode)}"
    parts = [occurred] + [even] * bool(len(mode)) + [f"{lost} without a mode"] * bool(lost)
    set_title(axes, ";\n".join((parts[0], "; ".join(parts[1:]))) if few and parts[1:] else "; ".join(parts))
    tidy(axes)
    axes.tick_params(axis="x", length=0)
    return save_figure(figure, path)


def recorded_modes(demonstrations: Mapping[str, Any], task: str | None) -> np.ndarray | None:
    """Modes of the demonstrations: those recorded, or for Avoiding those that their paths show.

    Args:
        demonstrations (mapping): ``mode`` [episodes], or ``position`` [N, 2] (m) with ``episode`` [N].
        task (str, optional): the task.

    Returns:
        np.ndarray or None: a mode per demonstration, -1 where a row was not passed; None if they cannot be known.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.reports.mode_plots import recorded_modes
        >>> path = np.array([[0.55, -0.1], [0.5, 0.08], [0.6, 0.27]])
        >>> recorded_modes({"position": path, "episode": np.zeros(3)}, "avoiding").tolist()
        [18]
    """
    if "mode" in demonstrations:
        return as_array("mode", demonstrations["mode"], [None]).astype(int)
    if task != "avoiding" or "position" not in demonstrations:
        return None
    position = as_array("position", demonstrations["position"], [None, 2])
    episode = as_array("episode", demonstrations["episode"], [len(position)])
    rows: dict[float, list[float]] = {}
    for _, x, y, *_ in OBSTACLES:
        rows.setdefault(y, []).append(x)
    modes = []
    for path in np.split(position, np.flatnonzero(np.diff(episode) != 0) + 1):
        mode = 0
        for number, (y, cylinders) in enumerate(sorted(rows.items())):
            last = number == len(rows) - 1
            near = path[:, 1] >= y if last else abs(path[:, 1] - y) <= _ROW_REACH
            gap = int((path[near.argmax(), 0] > cylinders).sum())
            mode = mode * (len(cylinders) + 1) + gap if near.any() and mode >= 0 else -1
        modes.append(mode)
    return np.array(modes)


def draw_mode_table(axes: Axes, mode: np.ndarray, choices: tuple, colors: np.ndarray) -> None:
    """A cell per mode in its colour, with the number of rollouts.

    Columns are the last of several choices. A single choice becomes a list with the names beside the cells (initials
    from 11 on), or a compact grid if its names are numbers.

    Args:
        axes (Axes): panel to fill.
        mode (np.ndarray): modes to count [n]; those out of range are left out.
        choices (tuple): see :func:`~torchrl_koap.tasks.modes.mode_choices`.
        colors (np.ndarray): a colour per mode [num_modes, 3].
    """
    names = choices[-1][1]
    number = len(colors)
    listed = len(choices) == 1 and not names[0].isdigit()
    if listed:
        down, step = (number, 4.0) if number <= 10 else (math.ceil(number / 2), 4.6)
        places = [(step * (index // down), index % down) for index in range(number)]
    else:
        across = min(len(names), 6) if len(choices) == 1 else len(names)
        down, step = math.ceil(number / across), 1.0
        places = [(index % across, index // across) for index in range(number)]
    counts = np.bincount(mode[(mode >= 0) & (mode < number)].astype(int), minlength=number)
    top, label = 1.0, {"size": 8, "color": MUTED}
    for index, (color, (column, row)) in enumerate(zip(colors, places, strict=True)):
        used = counts[index] > 0
        style = {"facecolor": color, "edgecolor": "white"} if used else {"facecolor": "none", "edgecolor": FAINT}
        axes.add_patch(Rectangle((column, top - row - 1), 0.92, 0.9, linewidth=0.8, **style))
        shade = "white" if used else FAINT
        text = {"ha": "center", "va": "center", "size": 9, "color": shade}
        axes.text(column + 0.46, top - row - 0.56, str(counts[index]), **text)
        if listed:
            name = names[index] if number <= 10 else initials(names[index])
            axes.text(column + 1.1, top - row - 0.56, name, ha="left", va="center", **label)
    if listed:
        axes.text(0, top + 0.12, choices[0][0], ha="left", va="bottom", **label)
    elif len(choices) > 1:
        for column, name in enumerate(names):
            axes.text(column + 0.46, top + 0.12, name.split()[-1], ha="center", va="bottom", **label)
        axes.text(0, top + 0.62, f"{choices[-1][0]}: gap from left to right", ha="left", va="bottom", **label)
        for row in range(down):
            words = " / ".join(_words(row, choices[:-1]))
            axes.text(-0.15, top - row - 0.56, words, ha="right", va="center", **label)
        heads = " / ".join(name for name, _ in choices[:-1])
        axes.text(-0.15, top + 0.12, heads, ha="right", va="bottom", **label)
    width = 1 + max(column for column, _ in places) + (step if listed else 0)
    axes.set_xlim(-2.1 if len(choices) > 1 else -0.1, width + 0.1)
    axes.set_ylim(top - down - 4, top + 1.6)
    axes.set_aspect("equal")
    axes.set_anchor("NW")
    axes.set_axis_off()
    set_title(axes, "successes by mode")


def _words(index: int, choices: tuple) -> list[str]:
    """Names of the values of all choices, the slowest first."""
    words = []
    for _, names in reversed(choices):
        index, digit = divmod(index, len(names))
        words.append(names[digit])
    return words[::-1]
