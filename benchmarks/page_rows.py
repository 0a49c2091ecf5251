# This source code is licensed under the MIT license found in the LICENSE file.
"""Formats tables of docs/results and the run times of their commands; draws the picture of Scooping.

    python benchmarks/page_rows.py --folder runs/scooping  # draws the picture

The picture shows frames of the recordings and the success rates of ``benchmarks/results/scooping.csv``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from paper_rows import count_by_observations, count_successes, finished_cells, label_shares, paper_cells_beside
from tables import METHOD_NAMES, SOURCE, fact, percent, read_rows, success_interval, table
from unlabelled_rows import REGIMES, followed

from torchrl_koap.reports.style import BLUE, INK, MUTED, ORANGE, PALE_BLUE, set_title, tidy
from torchrl_koap.studies.paper import Entry
from torchrl_koap.tasks.scooping import CAMERA, FRAME_HZ

STARTS = ("left", "near", "right")
_CELL = ("labels", "unlabelled", "method")
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "scooping.png"
SHOWN = 5  # frames per video
LABELS = ("2", "5")
# labelled part of each task
CONTROLLERS = {"avoiding": "1 trajectory", "stacking": "1 % of windows"}
COLORS = {"koap": BLUE, "koap_untrained": PALE_BLUE, "dp": MUTED, "linear": ORANGE}
NAMES = {
    "koap": "KOAP",
    "koap_untrained": "KOAP, features untrained",
    "dp": "Diffusion Policy",
    "linear": "ridge, raw frames",
}


def bench_rate(name: str, task: str, method: str) -> str:
    """Formats a method's success with the fewest labels over all seeds in whole percent."""
    return percent(count_successes(name, task, method, label_shares(name, task)[0]), 0)


def hours(name: str) -> str:
    """Formats the time of the controllers and rollouts of a comparison, each on one core."""
    seconds = sum(float(row[part] or 0) for row in finished_cells(name) for part in ("train_seconds", "eval_seconds"))
    return f"{seconds / 3600:.1f} core hours for controllers and rollouts, planners apart"


def minutes(name: str, column: str) -> str:
    """Formats the sum of a column of seconds in minutes; Adroit's two grounds score the same trainings."""
    rows = [row for row in read_rows(name) if row.get("ground") != "adroit_door_1_rad"]
    return f"{sum(float(row[column]) for row in rows) / 60:.0f} core minutes of training"


def paper_success_table(name: str) -> str:
    """Formats the success of KOAP here and in the paper: a row per task, a column per label level.

    "=" means that ours lies within the spread around the paper's mean; an arrow means that it lies above or below.
    """
    rows: dict[str, dict[int, str]] = {}
    for entry in paper_cells_beside(name):
        if entry.method == "koap":
            rows.setdefault(f"`{entry.task}`", {})[entry.level] = _beside_the_paper(entry)
    body = [[task, *(cells.get(level, "not run") for level in range(1, 6))] for task, cells in rows.items()]
    return table(["task", *(f"level {level}" for level in range(1, 6))], body)


def _beside_the_paper(entry: Entry) -> str:
    paper = f"{100 * entry.paper.success:.0f}"
    if entry.success is None:
        return f"not run / {paper}"
    away = entry.success - entry.paper.success
    mark = "=" if abs(away) <= entry.paper.spread else "↑" if away > 0 else "↓"
    return f"{100 * entry.success:.0f} {mark} {paper}"


def controllers_table() -> str:
    """Formats the success of KOAP, its controls and `mpc` with the same planner."""
    methods, body = ("koap", "koap_untrained", "linear_steps", "mpc"), []
    for task, text in CONTROLLERS.items():
        cells = [count_successes("controllers", task, method, 0.01) for method in methods]
        rates = [f"{percent(counts, 0)} of {counts['n']}" if counts["n"] else "not run" for counts in cells]
        body.append([f"`{task}`", text, *rates])
    return table(["task", "labelled", *(METHOD_NAMES.get(method, f"`{method}`") for method in methods)], body)


FOLLOWED = {
    "random features": "koap_untrained",
    "principal components": "pca",
    "`koap`": "koap",
    "`semi_supervised`": "semi_supervised",
}


def followed_table(labels: int, regimes: Sequence[str]) -> str:
    """Formats the share of held-out demonstrations followed: a row per observation model, a column per method.

    Args:
        labels (int): labelled demonstrations.
        regimes (sequence of str): observation models.
    """
    body = [
        [REGIMES[regime], *(followed(regime, labels, method).split(" of ")[0] for method in FOLLOWED.values())]
        for regime in regimes
    ]
    return table(["observation", *FOLLOWED], body)


SCOOPING_ROWS = (
    ("scooping", "2", "none"),
    ("scooping", "2", "robot"),
    ("scooping", "5", "none"),
    ("scooping", "5", "both"),
    ("scooping_moving_bowl", "5", "none"),
    ("scooping_moving_bowl", "5", "robot"),
    ("scooping_moving_bowl", "20", "none"),
    ("scooping_moving_bowl", "20", "robot"),
)


def scooping_matrix() -> str:
    """Formats success by bowl, labels and unlabelled videos; Diffusion Policy reads labelled data only."""
    methods = {"KOAP": "koap", "random features": "koap_untrained", "ridge": "linear", "Diffusion Policy": "dp"}
    body = []
    for task, labels, unlabelled in SCOOPING_ROWS:
        row = ["moves" if task.endswith("moving_bowl") else "fixed", labels, unlabelled]
        for method in methods.values():
            same = [
                cell
                for cell in scooping_cells(read_rows(task))
                if (cell["labels"], cell["method"]) == (labels, method)
                and (method == "dp" or cell["unlabelled"] == unlabelled)
            ]
            row.append(percent(same[0], 0) if same else "not run")
        body.append(row)
    return table(["bowl", "labelled", "unlabelled videos", *methods], body)


def suggestions_table() -> str:
    """Formats action errors by labelled demonstrations, and the difference of each criterion to random choice."""
    rows = read_rows("label_suggestions")
    criteria = list(dict.fromkeys(row["criterion"] for row in rows))
    body = []
    for chosen in dict.fromkeys(row["chosen"] for row in rows):
        found = {row["criterion"]: row for row in rows if row["chosen"] == chosen}
        body.append([chosen, found[criteria[0]]["random_error"]])
        body[-1] += [
            "{error}; {difference} ({difference_low} to {difference_high})".format(**found[name]) for name in criteria
        ]
    return table(["labelled", "random", *(f"`{name}`; difference" for name in criteria)], body)


def speed_table() -> str:
    """Formats times of training and planning, and rates of training and environments."""
    speed = {(row["part"], row["variant"].split()[0]): row for row in read_rows("training_speed")}
    ways = {row["way"]: row["p50_ms"] for row in read_rows("exported_policy")}
    env = read_rows("env_speed", task="avoiding", batch=60, threads=1)[0]
    planner = speed["planner", "default"]
    body = [
        ["`make demo`", fact("demo_total")],
        ["README example on own data", fact("own_data_fit")],
        ["planner updates (U-Net)", f"{planner['updates_per_second']} per second"],
        ["controller updates", f"{speed['controller', 'default']['updates_per_second']} per second"],
        ["one plan", f"{planner['plan_1_ms']} ms"],
        ["60 plans at once", f"{planner['plan_60_ms']} ms"],
        ["plan and actions, seven joints: Python / ONNX", f"{ways['eager']} / {ways['onnx']} ms"],
        ["60 copies of Avoiding", f"{int(env['median']):,} control steps per second"],
    ]
    return table(["what", "time or rate"], body)


def observation_rate(name: str, method: str, part: float) -> str:
    """Formats the success of a method with a share of the demonstrations."""
    return percent(count_by_observations(name)[part][method], 0)


def followed_rollouts(labels: int, regimes: Sequence[str]) -> str:
    """Formats the rollouts and seeds per entry of :func:`followed_table`: "180 (3 seeds) or 300 (5 seeds)"."""
    rows = [row for regime in regimes for row in read_rows("unlabelled_rollouts", regime=regime, labels=labels)]
    sizes: dict[tuple[str, str], list[int]] = {}
    for row in rows:
        if row["method"] in FOLLOWED.values():
            sizes.setdefault((row["regime"], row["method"]), []).append(int(row["n"]))
    return " or ".join(
        f"{n} ({seeds} seeds)" for n, seeds in sorted({(sum(each), len(each)) for each in sizes.values()})
    )


def requirement(name: str) -> str:
    """Returns the version requirement of a package in pyproject.toml."""
    text = (SOURCE.parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    return re.search(rf'"({name}[<>=][^"]*)"', text)[1]


def scooping_cells(rows: Sequence[Mapping[str, str]] | None = None) -> list[dict[str, Any]]:
    """Pools the rollouts of each cell over its training seeds; per seed the row with most rollouts counts.

    Args:
        rows (sequence of mapping, optional): rows of ``scooping.csv``. Default: the committed rows.

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
    """Formats a row per cell of the study.

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
    """Draws videos on the left, success rates with 95 % intervals on the right.

    Args:
        films (mapping): caption to the frames ``[T, H, W, 3]`` of a demonstration.
        cells (sequence of mapping): from :func:`scooping_cells`.
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
            rate, low, high = success_interval(cell["successes"], cell["n"])
            label = NAMES[method] if not group else None
            axes.bar(x, rate, width=0.19, color=COLORS[method], label=label)
            axes.vlines(x, low, high, color=INK, linewidth=1)
    axes.set(xticks=range(len(LABELS)), ylim=(0, 102), ylabel="success (%)")
    axes.set_xticklabels([f"{labels} labels" for labels in LABELS], fontsize=9)
    axes.legend(frameon=False, fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2)
    set_title(axes, "with a piece, 95 % intervals")
    tidy(axes)
    figure.savefig(path, dpi=100, facecolor="white", metadata={"Software": None})
    return path


def main(*, folder: Path) -> None:
    """Draws the picture of Scooping.

    Args:
        folder: recordings that benchmarks/scooping.py wrote.
    """
    from torchrl_koap.data import read_recordings  # imported here: needs an extra

    captions = {"hand": "a hand: no actions", "robot": "robot: few labels"}
    films = {
        words: np.stack(list(read_recordings(folder / who, episodes=[0], action_dim=7).cameras[CAMERA][0].read()))
        for who, words in captions.items()
    }
    print(draw(films, scooping_cells(), PICTURE), PICTURE.stat().st_size)


if __name__ == "__main__":
    tyro.cli(main)
