# This source code is licensed under the MIT license found in the LICENSE file.
"""The picture of docs/results/unlabelled_data.md: action error and success against labels, a column per regime."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

REGIMES = {
    "plain": "positions as recorded",
    "noise": "positions, noise of three steps",
    "wide_64": "64 nonlinear columns, noise",
    "wide_512": "512 nonlinear columns, noise",
    "pictures": "32 x 32 pictures, 64 components",
    "distractors": "64 columns, 2 distractors",
    "joints_hidden": "Stacking, joints hidden",
}
# the same with labels from random play alone, as the table calls them; not in the picture
PLAYED = {f"{name}, play": f"{title}; labels from random play" for name, title in REGIMES.items()}
CONTROLS = (
    *("semi_supervised", "semi_supervised, untrained", "semi_supervised, labelled only", "koap", "koap_untrained"),
    *("koap_labelled_only", "koap_paper", "pca", "linear_steps", "dd_lookahead"),
)
LOOKS = {
    "semi_supervised": ("#0b6e4f", "-", "o"),
    "koap": ("#4ba3c3", "-", "v"),
    "koap_untrained": ("#7a7a7a", "--", "s"),
    "koap_labelled_only": ("#9b5de5", "--", "P"),
    "koap_paper": ("#d4a017", "-", "X"),
    "pca": ("#c1440e", "-.", "D"),
    "linear_steps": ("#b0b0b0", ":", "^"),
    "dd_lookahead": ("#2f4b8f", ":", "*"),
}

Cells = Mapping[tuple[str, int], Mapping[int, float]]


def draw_unlabelled(errors: Mapping[str, Cells], successes: Mapping[str, Cells], folder: Path) -> Path:
    """Draws mean action errors above success in closed loop, a column per regime; a band is the range over seeds.

    Args:
        errors (mapping): for every regime, action errors by method and number of labelled trajectories, then by seed.
        successes (mapping): the same for the share of rollouts that succeed, where there are rollouts.
        folder (Path): where to.

    Returns:
        Path: the picture.
    """
    names = [name for name, cells in errors.items() if cells]
    figure, axes = plt.subplots(2, len(names), figsize=(2.5 * len(names), 5.2), squeeze=False, sharex="col")
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
    shown = [method for method in LOOKS if method in handles]
    figure.legend([handles[method] for method in shown], shown, loc="lower center", ncols=len(shown), frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    path = folder / "unlabelled_data.png"
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)
    return path


def _draw_lines(axis: Axes, cells: Cells) -> None:
    """A line per method; the range over seeds for the method itself alone, or they would hide each other."""
    for method, (color, line, marker) in LOOKS.items():
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
