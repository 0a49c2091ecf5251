# This source code is licensed under the MIT license found in the LICENSE file.
"""One picture for each page in docs/results that needs no recording: bars or lines with 95 % intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from page_rows import count_successes, label_shares
from paper_rows import count_by_observations
from tables import fact, planner_rows, read_rows

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.reports.style import BLUE, FAINT, INK, MUTED, ORANGE, tidy
from torchrl_koap.studies.presets import PAPER_TASKS

Point = tuple[float, float, float, float]  # x, mean, low, high
Bar = tuple[str, float, float, float]  # name, mean, low, high
COLORS = (BLUE, ORANGE, "#0b6e4f", "#7a7a7a")
MARKERS = ("o", "s", "^", "D")
SHOWN = {"koap": "KOAP", "koap_untrained": "random features", "linear_steps": "ridge", "dp": "Diffusion Policy"}


def draw_result_pictures(folder: Path) -> list[Path]:
    """Draws the picture of each page.

    Args:
        folder (Path): where to.
    """
    robot = read_rows("own_robot")
    errors = [(name, [float(row[f"{key}_error_rad"]) for row in robot]) for name, key in _ROBOT.items()]
    latent = {"Koopman model": "latent_koopman", "linear model on states": "latent_linear", "no motion": "latent_still"}
    ways = [(row["way"], float(row["p50_ms"]), float(row["p99_ms"])) for row in read_rows("exported_policy")]
    scores = [
        (
            f"seed {row['seed']}, {row['execution'].replace('_', ' ')}",
            float(row["largest_reward"]),
            float(row["standard_error"]),
        )
        for row in read_rows("proving_grounds", ground="pusht")
    ]
    return [
        draw_bars(
            [(name, sum(own) / len(own), min(own), max(own)) for name, own in errors],
            "action error (rad), mean and range over seeds",
            folder / "own_robot.png",
        ),
        draw_few_labels(folder / "few_labels.png"),
        draw_bars(_controllers(), "success (%)", folder / "controllers.png"),
        draw_lines(_planner_data(), "demonstrations (%)", "success (%)", folder / "unlabelled_planner.png"),
        draw_lines(_suggestions(), "labelled demonstrations", "action error (mm)", folder / "labelling.png"),
        draw_bars(
            [(name, value, value, value) for name, key in latent.items() for value in [float(fact(key, "bare"))]],
            "error after 10 control steps (mm), logarithmic",
            folder / "latent_space.png",
            log=True,
        ),
        draw_bars(
            [(name, mean, mean - 1.96 * error, mean + 1.96 * error) for name, mean, error in scores],
            "mean largest reward on Push-T",
            folder / "proving_grounds.png",
        ),
        draw_bars(
            [(way, median, median, worst) for way, median, worst in ways],
            "plan and actions of seven joints (ms), median and 99th percentile",
            folder / "speed.png",
        ),
    ]


_ROBOT = {"KOAP": "action", "ridge regression": "ridge"}


def _interval(successes: int, trials: int) -> tuple[float, float, float]:
    """Mean, low and high in percent."""
    low, high = wilson_interval(successes, trials)
    return 100 * successes / trials, 100 * low, 100 * high


def _controllers() -> list[Bar]:
    """Success of KOAP and of another controller behind the same planner."""
    bars = []
    for task, other in (("avoiding", "mpc"), ("stacking", "mpc")):
        for method in ("koap", other):
            rows = planner_rows(task, method)
            counts = (sum(int(row[key]) for row in rows) for key in ("successes", "n"))
            bars.append((f"{task}: {method}", *_interval(*counts)))
    for method in ("koap", "command_regression"):
        counts = count_successes("table_1", "stacking_unobserved_joints", method, 0.01)
        bars.append((f"joints hidden: {method}", *_interval(counts["successes"], counts["n"])))
    return bars


def _planner_data() -> dict[str, list[Point]]:
    """Success against the share of demonstrations that the planner knows, by method."""
    found = count_by_observations("study_observations_and_planner")
    return {
        name: [
            (100 * part, *_interval(own[method]["successes"], own[method]["n"])) for part, own in sorted(found.items())
        ]
        for method, name in SHOWN.items()
        if method in found[1.0]
    }


def _suggestions() -> dict[str, list[Point]]:
    """Action error against labelled demonstrations, by criterion."""
    rows = read_rows("label_suggestions")
    lines: dict[str, list[Point]] = {}
    for row in rows:
        spread = float(row["error"]), float(row["low"]), float(row["high"])
        lines.setdefault(row["criterion"], []).append((int(row["chosen"]), *spread))
    random = {int(row["chosen"]): float(row["random_error"]) for row in rows}
    return {"random": [(chosen, error, error, error) for chosen, error in random.items()]} | lines


def draw_few_labels(path: Path) -> Path:
    """Draws success against the labelled share, a panel per task.

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
            _line(axes, [(part, *_interval(own["successes"], own["n"])) for part, own in counts], SHOWN[method], number)
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
        xlabel (str): what is varied.
        ylabel (str): what is measured.
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
        xlabel (str): what is measured.
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
