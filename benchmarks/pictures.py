# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures of the README and of docs/results: pipeline, label curves, the paper's average, unlabelled data."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.ticker import FixedLocator, NullLocator
from paper_rows import draw_bench_average
from tables import read_rows
from unlabelled_rows import REGIMES, Cells, unlabelled_errors, unlabelled_successes

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.reports.style import BLUE, FAINT, INK, MUTED, ORANGE, PALE, set_title, tidy
from torchrl_koap.studies.plots import method_styles

_NAMES = {
    "koap": "KOAP",
    "koap_untrained": "KOAP, features untrained",
    "linear_steps": "ridge, KOAP's inputs",
    "linear": "ridge, raw frames",
    "dd_lookahead": "supervised, look-ahead",
    "dd": "supervised, next state",
    "dp": "Diffusion Policy",
}
_LOOKS = {
    "semi_supervised": ("#0b6e4f", "-", "o"),
    "koap": ("#4ba3c3", "-", "v"),
    "koap_untrained": ("#7a7a7a", "--", "s"),
    "koap_labelled_only": ("#9b5de5", "--", "P"),
    "koap_paper": ("#d4a017", "-", "X"),
    "pca": ("#c1440e", "-.", "D"),
    "linear_steps": ("#b0b0b0", ":", "^"),
    "dd_lookahead": ("#2f4b8f", ":", "*"),
}


def draw_all(folder: Path) -> list[Path]:
    """Draws every picture that is made from committed figures.

    Args:
        folder (Path): where to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    errors, successes = ({name: cells(name) for name in REGIMES} for cells in (unlabelled_errors, unlabelled_successes))
    return [
        draw_label_curves(label_curves(), folder / "success_and_entropy.png"),
        *(draw_pipeline(folder / f"pipeline.{kind}") for kind in ("svg", "png")),
        draw_bench_average("table_1", folder / "paper_average.png"),
        draw_unlabelled(errors, successes, folder / "unlabelled_data.png"),
    ]


def label_curves() -> dict[str, list[dict[str, float]]]:
    """Success with its interval and entropy against the labels on Avoiding, by method."""
    lines: dict[str, list[dict[str, float]]] = {method: [] for method in _NAMES}
    for row in read_rows("label_curves", study="avoiding"):
        if row["method"] in lines:
            won, of = int(row["successes"]), int(row["n"])
            point = dict(zip(("low", "high"), wilson_interval(won, of), strict=True)) | {"success": won / of}
            point |= {"fraction": float(row["label_fraction"]), "entropy": float(row["entropy"])}
            lines[row["method"]].append(point)
    return lines


def draw_label_curves(curves: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> Path:
    """Success with its interval, and entropy, against the labelled share, a line per method.

    Args:
        curves (mapping): by method its points, each with ``fraction``, ``success``, ``low``, ``high``, ``entropy``.
        path (Path): png to write.
    """
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    styles = method_styles(list(curves))
    for index, (method, points) in enumerate(curves.items()):
        style = styles[method]
        shift = 1.02 ** (index - (len(curves) - 1) / 2)  # whiskers beside each other
        place = [point["fraction"] * shift for point in points]
        line = {"color": style["color"], "marker": style["marker"], "linestyle": style["linestyle"], "markersize": 4.5}
        line |= {"linewidth": 1.5, "label": _NAMES.get(method, method)}
        left.plot(place, [100 * point["success"] for point in points], **line)
        ends = [100 * point["low"] for point in points], [100 * point["high"] for point in points]
        left.vlines(place, *ends, color=style["color"], linewidth=0.9, alpha=0.5)
        right.plot(place, [point["entropy"] for point in points], **line)
    shares = sorted({point["fraction"] for points in curves.values() for point in points})
    for axes, label, limits in ((left, "success (%)", (38, 102)), (right, "entropy of the modes", (-0.04, 1.04))):
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(shares))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
        axes.set(ylabel=label, ylim=limits, xlabel="demonstrations whose actions are known")
        axes.grid(axis="y", color=FAINT, linewidth=0.5)
        tidy(axes)
    set_title(left, "Avoiding: success, 95 % intervals")
    set_title(right, "variety of the successful rollouts (1: all modes alike often)")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8.5)
    figure.savefig(path, dpi=130, facecolor="white", metadata={"Software": None})
    return path


def draw_pipeline(path: Path) -> Path:
    """States, plan, latent action, action: what each part reads and whether it needs labels.

    Args:
        path (Path): svg or png to write.
    """
    figure = Figure(figsize=(9.6, 2.75))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 96), ylim=(0, 27.5))
    axes.set_axis_off()
    axes.add_patch(_box(17.5, 13.2, 49.5, 13.3, facecolor="#eef4ff", edgecolor="none"))
    axes.text(42.2, 24.6, "learned from states alone: every demonstration", ha="center", size=9, color=BLUE)
    axes.add_patch(_box(69.2, 13.2, 11.2, 13.3, facecolor="#fff1e3", edgecolor="none"))
    axes.text(74.8, 24.6, "few labels", ha="center", size=9, color=ORANGE)
    words = (
        (1.5, 11, "states", "$x_{t-1}, x_t$", MUTED),
        (20, 12, "planner", "diffusion model", BLUE),
        (36.4, 11.2, "plan", "$x_{t+1} \\ldots x_{t+14}$", MUTED),
        (52.2, 13.4, "Koopman model", "$z' = Kz + Bu$", BLUE),
        (70, 9.6, "decoder", "linear", ORANGE),
        (84.5, 10, "action", "$a_t$", MUTED),
    )
    for x, width, head, text, color in words:
        kind = {"facecolor": PALE if color == MUTED else "white", "edgecolor": color, "linewidth": 1.3}
        axes.add_patch(_box(x, 14.5, width, 8, **kind))
        axes.text(x + width / 2, 19.7, head, ha="center", va="center", size=10, color=INK, weight="bold")
        axes.text(x + width / 2, 16.7, text, ha="center", va="center", size=9, color=INK)
    for (x, width, *_), (after, *_) in zip(words, words[1:], strict=False):
        _arrow(axes, (x + width, 18.5), (after, 18.5))
    axes.text(67.4, 19.3, "$u_t$", ha="center", size=10, color=INK)
    axes.text(67.4, 10.4, "latent action", ha="center", size=9, color=MUTED)
    axes.plot([67.4, 67.4], [12.3, 17.6], color=MUTED, linewidth=0.7, linestyle=":")
    axes.plot([89.5, 89.5, 7], [14.5, 4.5, 4.5], color=INK, linewidth=1.1)
    _arrow(axes, (7, 4.5), (7, 14.5))
    axes.text(
        48, 5.4, "environment: four actions of every plan are executed, then a new plan is made", ha="center", size=9
    )
    options = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with rc_context({"svg.hashsalt": "torchrl_koap"}):  # the same file at every call
        figure.savefig(path, dpi=130, facecolor="white", metadata=options)
    return path


def _box(x: float, y: float, width: float, height: float, **style) -> FancyBboxPatch:
    return FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=1.1", **style)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=INK, linewidth=1.1))


def draw_unlabelled(errors: Mapping[str, Cells], successes: Mapping[str, Cells], path: Path) -> Path:
    """Mean action errors above success in closed loop, a column per observation setting.

    Args:
        errors (mapping): by setting, action errors by method and number of labelled trajectories, then by seed.
        successes (mapping): the same for the share of rollouts that succeed, where there are rollouts.
        path (Path): png to write.
    """
    names = [name for name, cells in errors.items() if cells]
    figure = Figure(figsize=(2.5 * len(names), 5.2))
    axes = figure.subplots(2, len(names), squeeze=False, sharex="col")
    for column, name in enumerate(names):
        top, bottom = axes[:, column]
        _draw_lines(top, errors[name])
        top.set_ylim(bottom=0)
        top.set_title(REGIMES[name], fontsize=9)
        rolled_out = {cell: _percent(seeds) for cell, seeds in successes.get(name, {}).items()}
        _draw_lines(bottom, rolled_out)
        bottom.set_ylim(-3, 103)
        if not rolled_out:
            bottom.text(0.5, 0.5, "not rolled out", transform=bottom.transAxes, ha="center", color="#7a7a7a")
        bottom.set_xlabel("labelled trajectories")
        labels = sorted({number for _, number in errors[name]})
        bottom.set_xscale("log", base=2)
        bottom.set_xticks(labels, [str(number) for number in labels])
        bottom.minorticks_off()
    axes[0, 0].set_ylabel("action error (mm, mrad)")
    axes[1, 0].set_ylabel("success (%)")
    handles = {
        label: handle for axis in axes[0] for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    shown = [method for method in _LOOKS if method in handles]
    figure.legend([handles[method] for method in shown], shown, loc="lower center", ncols=len(shown), frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    figure.savefig(path, dpi=130, metadata={"Software": None})
    return path


def _draw_lines(axis: Axes, cells: Cells) -> None:
    """A line per method; the range over seeds for the method itself alone, or they would hide each other."""
    for method, (color, line, marker) in _LOOKS.items():
        points = sorted((number, list(seeds.values())) for (name, number), seeds in cells.items() if name == method)
        if not points:
            continue
        x = [number for number, _ in points]
        if method == "semi_supervised":
            axis.fill_between(x, *([end(e) for _, e in points] for end in (min, max)), color=color, alpha=0.15, lw=0)
        axis.plot(x, [statistics.fmean(e) for _, e in points], color=color, ls=line, marker=marker, ms=4, label=method)
    axis.spines[["top", "right"]].set_visible(False)


def _percent(seeds: Mapping[int, float]) -> dict[int, float]:
    return {seed: 100 * share for seed, share in seeds.items()}
