# This source code is licensed under the MIT license found in the LICENSE file.
"""The picture of docs/results/unlabelled_data.md: action error against labelled trajectories, a panel per regime."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt

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
    "koap_untrained": ("#7a7a7a", "--", "s"),
    "linear_steps": ("#b0b0b0", ":", "^"),
    "pca": ("#c1440e", "-.", "D"),
}

Cells = Mapping[tuple[str, int], Mapping[int, float]]


def draw_errors(regimes: Mapping[str, Cells], folder: Path) -> Path:
    """Draws mean errors and their range over seeds.

    Args:
        regimes (mapping): for every regime, errors by method and number of labelled trajectories, then by seed.
        folder (Path): where to.

    Returns:
        Path: the picture.
    """
    regimes = {name: cells for name, cells in regimes.items() if cells}
    figure, axes = plt.subplots(1, len(regimes), figsize=(3.0 * len(regimes), 3.1), squeeze=False)
    for axis, (name, cells) in zip(axes[0], regimes.items(), strict=True):
        labels = sorted({number for _, number in cells})
        for method, (color, line, marker) in LOOKS.items():
            points = [(x, list(cells[method, x].values())) for x in labels if cells.get((method, x))]
            if not points:
                continue
            x = [number for number, _ in points]
            axis.fill_between(x, *([end(e) for _, e in points] for end in (min, max)), color=color, alpha=0.12, lw=0)
            mean = [statistics.fmean(errors) for _, errors in points]
            axis.plot(x, mean, color=color, ls=line, marker=marker, ms=4, label=method)
        axis.set_xscale("log", base=2)
        axis.set_xticks(labels, [str(number) for number in labels])
        axis.minorticks_off()
        axis.set_ylim(bottom=0)
        axis.set_title(REGIMES[name], fontsize=9)
        axis.set_xlabel("labelled trajectories")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("action error (mm, mrad)")
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="lower center", ncols=4, frameon=False)
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    path = folder / "unlabelled_data.png"
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)
    return path
