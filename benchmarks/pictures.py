# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws the pictures of the README and docs/results that need no recordings: pipeline, curves and bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ground_rows import draw_grounds
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from page_rows import CONTROLLERS
from paper_rows import count_by_observations, count_successes, draw_bench_average, label_shares
from tables import fact, read_rows, success_interval
from unlabelled_rows import draw_unlabelled

from torchrl_koap.reports.style import BLUE, FAINT, INK, MUTED, ORANGE, PALE, tidy
from torchrl_koap.studies.study import PAPER_TASKS

Point = tuple[float, float, float, float]  # x, mean, low, high
Bar = tuple[str, float, float, float]  # name, mean, low, high
COLORS = (BLUE, ORANGE, "#0b6e4f", "#7a7a7a")
MARKERS = ("o", "s", "^", "D")
SHOWN = {"koap": "KOAP", "koap_untrained": "random features", "linear_steps": "ridge", "dp": "Diffusion Policy"}
_ROBOT = {"KOAP": "action", "ridge on raw frames": "ridge"}


def draw_all(folder: Path) -> list[Path]:
    """Draws every picture made from committed figures into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = read_rows("own_robot")
    errors = [(name, [float(row[f"{key}_error_rad"]) for row in robot]) for name, key in _ROBOT.items()]
    latent = {"Koopman model": "latent_koopman", "linear model on states": "latent_linear", "no motion": "latent_still"}
    ways = [(row["way"], float(row["p50_ms"]), float(row["p99_ms"])) for row in read_rows("exported_policy")]
    return [
        draw_pipeline(folder / "pipeline.svg"),
        draw_bench_average("table_1", folder / "paper_average.png"),
        draw_unlabelled(folder / "unlabelled_data.png"),
        draw_bars(
            [(name, sum(own) / len(own), min(own), max(own)) for name, own in errors],
            "action error (rad), mean and range over seeds",
            folder / "own_robot.png",
        ),
        draw_few_labels(folder / "few_labels.png"),
        draw_bars(_controllers(), "success (%)", folder / "controllers.png"),
        draw_lines(_planner_data(), "demonstrations (%)", "success (%)", folder / "unlabelled_planner.png"),
        draw_lines(
            _suggestions(), "labelled demonstrations", "action error (mm), mean and range", folder / "labelling.png"
        ),
        draw_bars(
            [(name, value, value, value) for name, key in latent.items() for value in [float(fact(key, "bare"))]],
            "error after 10 control steps (mm), logarithmic",
            folder / "latent_space.png",
            log=True,
        ),
        draw_grounds(folder / "proving_grounds.png"),
        draw_bars(
            [(way, median, median, worst) for way, median, worst in ways],
            "plan and actions of seven joints (ms), median and 99th percentile",
            folder / "speed.png",
        ),
    ]


def draw_pipeline(path: Path) -> Path:
    """Which recordings train which part, and what each part reads in the control loop.

    Args:
        path (Path): svg to write.
    """
    figure = Figure(figsize=(9.6, 3.6))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 96), ylim=(0, 36))
    axes.set_axis_off()
    for bar in range(50):  # recordings
        kind = {"facecolor": ORANGE if bar in (4, 17, 21, 38, 40) else FAINT, "edgecolor": "none"}
        axes.add_patch(_box(1.5 + bar % 10 * 1.15, 32.6 - bar // 10 * 1.9, 0.75, 1.4, radius=0.2, **kind))
    axes.text(14.5, 32.4, "50 recordings of states train planner and Koopman model", size=9, color=BLUE)
    axes.text(27.2, 27.0, "5 of them with actions fit the decoder", size=9, color=ORANGE)
    words = (
        (1.5, 11, "states", "$x_{t-4} \\ldots x_t$", MUTED),
        (20, 12, "planner", "diffusion model", BLUE),
        (36.4, 11.2, "plan", "$x_{t+1} \\ldots x_{t+14}$", MUTED),
        (52.2, 14.4, "Koopman model", "$z_{t+1} = Kz_t + Bu_t$", BLUE),
        (71, 9.6, "decoder", "$a_t = Du_t$", ORANGE),
        (84.5, 10, "action", "$a_t$", MUTED),
    )
    for x, width, head, text, color in words:
        kind = {"facecolor": PALE if color == MUTED else "white", "edgecolor": color, "linewidth": 1.3}
        axes.add_patch(_box(x, 14.5, width, 8, **kind))
        axes.text(x + width / 2, 19.7, head, ha="center", va="center", size=10, color=INK, weight="bold")
        axes.text(x + width / 2, 16.7, text, ha="center", va="center", size=9, color=INK)
    for (x, width, *_), (after, *_) in zip(words, words[1:], strict=False):
        _arrow(axes, (x + width, 18.5), (after, 18.5))
    for start, end, height, color in ((14.5, 26, 31.4, BLUE), (26, 59.4, 31.4, BLUE), (14.5, 75.8, 26.2, ORANGE)):
        axes.plot([start, end], [height, height], color=color, linewidth=1.1)
        _arrow(axes, (end, height), (end, 22.5), color)
    axes.text(68.8, 19.3, "$u_t$", ha="center", size=10, color=INK)
    axes.text(68.8, 12.2, "latent action", ha="center", size=9, color=MUTED)
    axes.plot([10, 10, 59.4], [14.5, 9.8, 9.8], color=INK, linewidth=1.1)
    _arrow(axes, (59.4, 9.8), (59.4, 14.5))
    axes.text(34.7, 10.6, "the present state and four past ones", ha="center", size=9)
    axes.plot([89.5, 89.5, 5], [14.5, 3.5, 3.5], color=INK, linewidth=1.1)
    _arrow(axes, (5, 3.5), (5, 14.5))
    axes.text(48, 4.4, "robot: four actions of every plan are executed, then a new plan is made", ha="center", size=9)
    with rc_context({"svg.hashsalt": "torchrl_koap"}):  # makes the file reproducible
        figure.savefig(path, dpi=130, facecolor="white", metadata={"Date": None})
    return path


def _box(x: float, y: float, width: float, height: float, radius: float = 1.1, **style) -> FancyBboxPatch:
    return FancyBboxPatch((x, y), width, height, boxstyle=f"round,pad=0,rounding_size={radius}", **style)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], color: str = INK) -> None:
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=color, linewidth=1.1))


def _controllers() -> list[Bar]:
    """Returns the success of KOAP and of `mpc` with the same planner."""
    bars = []
    for task in CONTROLLERS:
        for method in ("koap", "mpc"):
            counts = count_successes("controllers", task, method, 0.01)
            bars.append((f"{task}: {method}", *success_interval(counts["successes"], counts["n"])))
    return bars


def _planner_data() -> dict[str, list[Point]]:
    """Returns success by the share of demonstrations that the planner is trained on, for each method."""
    found = count_by_observations("study_observations_and_planner")
    return {
        name: [
            (100 * part, *success_interval(own[method]["successes"], own[method]["n"]))
            for part, own in sorted(found.items())
        ]
        for method, name in SHOWN.items()
        if method in found[1.0]
    }


def _suggestions() -> dict[str, list[Point]]:
    """Returns action errors by labelled demonstrations, for each criterion."""
    rows = read_rows("label_suggestions")
    lines: dict[str, list[Point]] = {}
    for row in rows:
        spread = float(row["error"]), float(row["low"]), float(row["high"])
        lines.setdefault(row["criterion"], []).append((int(row["chosen"]), *spread))
    random = {int(row["chosen"]): float(row["random_error"]) for row in rows}
    return {"random": [(chosen, error, error, error) for chosen, error in random.items()]} | lines


def draw_few_labels(path: Path) -> Path:
    """Draws success over the labelled share, a panel per task.

    Args:
        path (Path): png to write.
    """
    figure = Figure(figsize=(11, 2.9), layout="constrained")
    panels = figure.subplots(1, len(PAPER_TASKS), sharey=True)
    for axes, task in zip(panels, PAPER_TASKS, strict=True):
        for number, method in enumerate(SHOWN):
            counts = [
                (100 * part, count_successes("table_1", task, method, part)) for part in label_shares("table_1", task)
            ]
            points = [(part, *success_interval(own["successes"], own["n"])) for part, own in counts if own]
            if points:
                _line(axes, points, SHOWN[method], number)
        axes.set_title(task.replace("_unobserved_joints", ", joints hidden").replace("_", " "), fontsize=9)
        axes.set(xscale="log", ylim=(-3, 103))
        axes.set_xticks(
            ticks := [100 * part for part in label_shares("table_1", task)], [f"{tick:g}" for tick in ticks]
        )
        axes.minorticks_off()
        axes.set_xlabel("labelled windows (%)", fontsize=8)
    panels[0].set_ylabel("success (%)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return _save(figure, path)


def draw_lines(lines: Mapping[str, Sequence[Point]], xlabel: str, ylabel: str, path: Path) -> Path:
    """Draws a line with intervals per name.

    Args:
        lines (mapping): name to points.
        xlabel (str): label of the horizontal axis.
        ylabel (str): label of the vertical axis.
        path (Path): png to write.
    """
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    for number, (name, points) in enumerate(lines.items()):
        _line(axes, points, name, number)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.legend(frameon=False)
    return _save(figure, path)


def _line(axes, points: Sequence[Point], name: str, number: int) -> None:
    x, mean, low, high = zip(*points, strict=True)
    color = COLORS[number % len(COLORS)]
    axes.plot(x, mean, color=color, marker=MARKERS[number % len(MARKERS)], markersize=4, linewidth=1.4, label=name)
    axes.vlines(x, low, high, color=color, linewidth=0.9, alpha=0.5)
    axes.grid(axis="y", color=FAINT, linewidth=0.5)
    tidy(axes)


def draw_bars(bars: Sequence[Bar], xlabel: str, path: Path, log: bool = False) -> Path:
    """Draws a horizontal bar with its interval per name.

    Args:
        bars (sequence of tuple): name, mean, ends of the interval.
        xlabel (str): label of the horizontal axis.
        path (Path): png to write.
        log (bool): logarithmic axis.
    """
    figure = Figure(figsize=(6.4, 0.9 + 0.36 * len(bars)), layout="constrained")
    axes = figure.subplots()
    for place, (name, mean, low, high) in enumerate(reversed(bars)):
        axes.barh(place, mean, height=0.6, color=BLUE if "koap" in name.lower() or place == len(bars) - 1 else MUTED)
        axes.plot([low, high], [place, place], color=INK, linewidth=1.1)
        axes.annotate(f" {mean:.3g}", (max(mean, high), place), va="center", fontsize=9, color=INK)
    axes.set_yticks(range(len(bars)), [name for name, *_ in reversed(bars)])
    axes.set_xlabel(xlabel)
    axes.margins(x=0.12)
    if log:
        axes.set_xscale("log")
    tidy(axes)
    return _save(figure, path)


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=130, facecolor="white", metadata={"Software": None})
    return path
