# This source code is licensed under the MIT license found in the LICENSE file.
"""Cells of the page about Scooping, and its picture in the README: demonstrations, and success by method.

    python benchmarks/scooping_rows.py --folder runs/scooping  # draws the picture

Its frames are those of the recordings, its bars those of ``benchmarks/results/scooping.csv``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from tables import percent, read_rows, table

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.reports.style import BLUE, INK, MUTED, ORANGE, PALE_BLUE, set_title, tidy
from torchrl_koap.tasks.scooping import CAMERA, FRAME_HZ

STARTS = ("left", "near", "right")
_CELL = ("labels", "unlabelled", "method")
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "scooping.png"
SHOWN = 5  # frames of each film
LABELS = ("2", "5")
COLORS = {"koap": BLUE, "koap_untrained": PALE_BLUE, "dp": MUTED, "linear": ORANGE}
NAMES = {
    "koap": "KOAP",
    "koap_untrained": "KOAP, features untrained",
    "dp": "Diffusion Policy",
    "linear": "ridge, raw frames",
}


def scooping_cells(rows: Sequence[Mapping[str, str]] | None = None) -> list[dict[str, Any]]:
    """Cells of the study, each with the rollouts of all its training seeds; of a seed those of its longest row.

    Args:
        rows (sequence of mapping, optional): rows of ``scooping.csv``. Default: those that are committed.

    Returns:
        list of dict: the cell's columns, ``n``, ``successes``, ``rims``, ``seeds``, mean rates by start position, and
        ``action_error_mrad``, a list with an entry per seed.
    """
    longest: dict[tuple[str, ...], dict[str, Mapping[str, str]]] = {}
    for row in read_rows("scooping") if rows is None else rows:
        seeds = longest.setdefault(tuple(row[key] for key in _CELL), {})
        if row["seed"] not in seeds or int(seeds[row["seed"]]["n"]) < int(row["n"]):
            seeds[row["seed"]] = row
    cells = []
    for cell, seeds in longest.items():
        own = list(seeds.values())
        counts = {key: sum(int(row[key]) for row in own) for key in ("n", "successes", "rims")}
        rates = {s: sum(int(row["n"]) * float(row[s]) for row in own) / counts["n"] for s in STARTS}
        errors = [float(row["action_error_mrad"]) for row in own if row["action_error_mrad"]]
        more = {"seeds": sorted(seeds), "action_error_mrad": errors}
        cells.append(dict(zip(_CELL, cell, strict=True)) | counts | rates | more)
    return cells


def scooping_table(task: str = "scooping") -> str:
    """A row per cell of the study.

    Args:
        task (str): ``"scooping"`` or ``"scooping_moving_bowl"``.
    """
    cells = scooping_cells(read_rows(task))
    order = ("both", "robot", "hand", "none")
    cells.sort(key=lambda cell: (int(cell["labels"]), order.index(cell["unlabelled"]), -cell["successes"] / cell["n"]))
    body = []
    for cell in cells:
        starts = " / ".join(f"{100 * cell[start]:.0f}" for start in STARTS)
        errors = sorted(cell["action_error_mrad"])
        error = f"{errors[0]:.0f}" + (f" to {errors[-1]:.0f}" if len(errors) > 1 else "") if errors else "not measured"
        rim = percent({"successes": cell["rims"], "n": cell["n"]}, 0)
        first = [cell["labels"], cell["unlabelled"], f"`{cell['method']}`", " ".join(cell["seeds"]), str(cell["n"])]
        body.append([*first, rim, percent(cell, 0), starts, error])
    head = ["labelled", "unlabelled", "method", "seeds", "rollouts", "rim", "success", "left / near / right (%)"]
    return table([*head, "action error (mrad)"], body)


def draw(films: Mapping[str, np.ndarray], cells: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Films to the left, bars of success with 95 % intervals to the right.

    Args:
        films (mapping): by caption the frames ``[T, H, W, 3]`` of a demonstration.
        cells (sequence of mapping): of :func:`scooping_cells`.
        path (Path): png to write.
    """
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.75, 1))
    for row, (caption, frames) in zip(left.subplots(len(films), SHOWN), films.items(), strict=True):
        for axes, moment in zip(row, np.linspace(0, len(frames) - 1, SHOWN).astype(int), strict=True):
            axes.imshow(frames[moment])
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(f"{moment / FRAME_HZ:.1f} s", fontsize=8, color=MUTED, labelpad=2)
            axes.spines[:].set_visible(False)
        row[0].set_ylabel(caption, fontsize=9)
    axes = right.subplots()
    shown = {(cell["labels"], cell["method"]): cell for cell in cells if cell["unlabelled"] == "both"}
    for group, labels in enumerate(LABELS):
        for place, method in enumerate(NAMES):
            cell = shown.get((labels, method))
            if cell is None:
                continue
            x = group + (place - 1.5) * 0.21
            low, high = (100 * end for end in wilson_interval(cell["successes"], cell["n"]))
            label = NAMES[method] if not group else None
            axes.bar(x, 100 * cell["successes"] / cell["n"], width=0.19, color=COLORS[method], label=label)
            axes.vlines(x, low, high, color=INK, linewidth=1)
    axes.set(xticks=range(len(LABELS)), ylim=(0, 102), ylabel="success (%)")
    axes.set_xticklabels([f"{labels} labels" for labels in LABELS], fontsize=9)
    axes.legend(frameon=False, fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    set_title(axes, "with a piece, 95 % intervals")
    tidy(axes)
    figure.savefig(path, dpi=100, facecolor="white", metadata={"Software": None})
    return path


def main(*, folder: Path) -> None:
    """Draws the picture.

    Args:
        folder: of benchmarks/scooping.py.
    """
    from torchrl_koap.data import read_recordings  # needs an extra

    captions = {"hand": "a hand: no actions", "robot": "robot: few labels"}
    films = {
        words: np.stack(list(read_recordings(folder / who, episodes=[0], action_dim=7).cameras[CAMERA][0].read()))
        for who, words in captions.items()
    }
    print(draw(films, scooping_cells(), PICTURE), PICTURE.stat().st_size)


if __name__ == "__main__":
    tyro.cli(main)
