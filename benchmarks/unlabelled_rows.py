# This source code is licensed under the MIT license found in the LICENSE file.
"""Formats tables and draws the picture of docs/results/unlabelled_data.md: errors and success in closed loop."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tables import percent, read_rows, t_interval, table

REGIMES = {
    "plain": "positions as recorded",
    "noise": "positions, noise of 3 steps",
    "wide_64": "64 nonlinear columns, noise",
    "wide_512": "512 nonlinear columns, noise",
    "pictures": "32 x 32 pictures, 64 components",
    "distractors": "64 nonlinear columns, 2 distractors",
    "joints_hidden": "Stacking, joints hidden",
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
Cells = dict[tuple[str, int], dict[int, float]]  # method and labelled trajectories -> seed -> value


def unlabelled_errors(regime: str) -> Cells:
    """Reads action errors of an observation setting by method and labelled trajectories, then by seed."""
    found: Cells = {}
    for row in read_rows("unlabelled_data", regime=regime):
        found.setdefault((row["method"], int(row["labels"])), {})[int(row["seed"])] = float(row["error"])
    return found


def unlabelled_successes(regime: str) -> Cells:
    """Reads success rates of an observation setting by method and labelled trajectories, then by seed."""
    found: Cells = {}
    for row in read_rows("unlabelled_rollouts", regime=regime):
        cell = found.setdefault((row["method"], int(row["labels"])), {})
        cell[int(row["seed"])] = int(row["successes"]) / int(row["n"])
    return found


def gains_table(regimes: Sequence[str], **against: str) -> str:
    """Formats the error reduction of ``semi_supervised`` in percent, paired by seed, with a 95 % t-interval.

    Args:
        regimes (sequence of str): observation settings; each has a row per number of labelled trajectories.
        **against: heading of a column to the method compared with.
    """
    body = []
    for regime in regimes:
        cells = unlabelled_errors(regime)
        for number in sorted({number for _, number in cells}):
            row = [REGIMES[regime], str(number)]
            for method in against.values():
                own, other = (cells.get((name, number), {}) for name in ("semi_supervised", method))
                row.append(paired_gain([100 * (1 - own[seed] / other[seed]) for seed in own.keys() & other.keys()]))
            body.append(row)
    return table(["observed", "labelled", *(f"against {name.replace('_', ' ')}" for name in against)], body)


def successes_table(methods: Sequence[str]) -> str:
    """Formats success in closed loop, and the lead of ``semi_supervised`` in percentage points, paired by seed.

    Args:
        methods (sequence of str): columns besides ``semi_supervised``.
    """
    body = []
    for regime, title in REGIMES.items():
        cells = unlabelled_successes(regime)
        for number in sorted({number for method, number in cells if method == "semi_supervised"}):
            own = cells["semi_supervised", number]
            row = [title, str(number), followed(regime, number, "semi_supervised")]
            for method in methods:
                other = cells.get((method, number), {})
                ahead = [100 * (own[seed] - other[seed]) for seed in own.keys() & other.keys()]
                row.append(
                    f"{followed(regime, number, method)}; {paired_gain(ahead, unit='points')}" if other else "not run"
                )
            body.append(row)
    return table(["observed", "labelled", "`semi_supervised`", *(f"`{method}`; behind by" for method in methods)], body)


def followed(regime: str, labels: int, method: str) -> str:
    """Formats the share of held-out demonstrations followed to the end, over all seeds."""
    rows = read_rows("unlabelled_rollouts", regime=regime, labels=labels, method=method)
    counts = {key: sum(int(row[key]) for row in rows) for key in ("successes", "n")}
    return f"{percent(counts, 0)} of {counts['n']}"


def paired_gain(gains: Sequence[float], unit: str = "%") -> str:
    """Formats the mean of gains with its 95 % t-interval; fewer than three gains have no interval.

    Args:
        gains (sequence of float): one per seed.
        unit (str): unit of the gains, such as percentage ``"points"``.
    """
    if len(gains) < 3:
        return f"{statistics.fmean(gains):+.0f} {unit} ({len(gains)} seeds)" if gains else "not run"
    return "{:+.0f} {unit} ({:+.0f} to {:+.0f})".format(*t_interval(gains), unit=unit)


def draw_unlabelled(path: Path) -> Path:
    """Draws a png: mean action errors above success in closed loop, a column per observation setting."""
    errors, successes = ({name: cells(name) for name in REGIMES} for cells in (unlabelled_errors, unlabelled_successes))
    names = [name for name, cells in errors.items() if cells]
    figure = Figure(figsize=(2.5 * len(names), 5.2))
    axes = figure.subplots(2, len(names), squeeze=False, sharex="col")
    for column, name in enumerate(names):
        top, bottom = axes[:, column]
        _draw_lines(top, errors[name])
        top.set_ylim(bottom=0)
        top.set_title(REGIMES[name], fontsize=9)
        rolled_out = {cell: _percent(seeds) for cell, seeds in successes[name].items()}
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
    """Draws a line per method; only ``semi_supervised`` has its range over seeds, as ranges would overlap."""
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
