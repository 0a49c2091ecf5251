# This source code is licensed under the MIT license found in the LICENSE file.
"""Tables of the page about Scooping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from result_rows import percent, rows_if_measured, table

from torchrl_koap.tasks.scooping import EMBEDDING_DIM, IMAGE_SIZE

STARTS = ("left", "near", "right")
_CELL = ("labels", "unlabelled", "method", "execution", "blend_decay")
_HOW = ("open_loop", "0.0")  # execution and blending of plans in the study itself


def scooping_cells(rows: Sequence[Mapping[str, str]] | None = None) -> list[dict[str, Any]]:
    """Cells of the study, each with the rollouts of all its training seeds; of a seed those of its longest row.

    Args:
        rows (sequence of mapping, optional): rows of ``scooping.csv``. Default: those that are committed.

    Returns:
        list of dict: the cell's columns, ``n``, ``successes``, ``rims``, ``seeds``, mean rates by start position, and
        ``action_error_mrad``, a list with an entry per seed.
    """
    longest: dict[tuple[str, ...], dict[str, Mapping[str, str]]] = {}
    for row in rows_if_measured("scooping") if rows is None else rows:
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


def scooping_cell(
    labels: int, method: str, unlabelled: str = "both", rims: bool = False, task: str = "scooping"
) -> str:
    """Success of a cell of the study in words, or how often the spoon came over the rim.

    Args:
        labels (int): labelled demonstrations.
        method (str): its name.
        unlabelled (str): whose demonstrations there are besides.
        rims (bool): the rim instead of the success.
        task (str): ``"scooping"`` or ``"scooping_moving_bowl"``.
    """
    cell = _cell(task, labels, unlabelled, method)
    shown = {"successes": cell["rims" if rims else "successes"], "n": cell["n"]}
    seeds = len(cell["seeds"])
    return f"{percent(shown, 0)} of {cell['n']} rollouts, {seeds} seed{'s' if seeds > 1 else ''}"


def scooping_start(labels: int, method: str, unlabelled: str, start: str, task: str = "scooping") -> str:
    """How often a cell succeeds from one of the start positions, in percent; arguments as of :func:`scooping_cell`."""
    return f"{100 * _cell(task, labels, unlabelled, method)[start]:.0f} %"


def _cell(task: str, labels: int, unlabelled: str, method: str) -> dict[str, Any]:
    """A cell whose plans are followed as the study does."""
    wanted = (str(labels), unlabelled, method, *_HOW)
    for cell in scooping_cells(rows_if_measured(task)):
        if tuple(cell[key] for key in _CELL) == wanted:
            return cell
    raise KeyError(f"{task}.csv has no row of {wanted}")


def scooping_table(task: str = "scooping") -> str:
    """A row per cell of the study: plans decoded once and left as they are.

    Args:
        task (str): ``"scooping"`` or ``"scooping_moving_bowl"``.
    """
    cells = [
        cell for cell in scooping_cells(rows_if_measured(task)) if (cell["execution"], cell["blend_decay"]) == _HOW
    ]
    order = ("both", "robot", "hand_aligned", "hand", "none")
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


def scooping_plans_table() -> str:
    """A row per way to follow plans, of the cells that were followed in more than one."""
    cells = scooping_cells([row for row in rows_if_measured("scooping") if row["n"] == "15"])
    ways: dict[tuple[str, ...], int] = {}
    for cell in cells:
        ways[tuple(cell[key] for key in _CELL[:3])] = ways.get(tuple(cell[key] for key in _CELL[:3]), 0) + 1
    body = []
    for cell in cells:
        if ways[tuple(cell[key] for key in _CELL[:3])] > 1:
            decoded = "once per plan" if cell["execution"] == "open_loop" else "at every step"
            bent = f"{cell['blend_decay']}" if float(cell["blend_decay"]) else "not at all"
            rim = percent({"successes": cell["rims"], "n": cell["n"]}, 0)
            body.append(
                [decoded, bent, f"`{cell['method']}`, {cell['labels']} labels", str(cell["n"]), rim, percent(cell, 0)]
            )
    return table(["targets are decoded", "the plan is bent, decay", "run", "rollouts", "rim", "success"], body)


def scooping_probe_table() -> str:
    """A row per size of the frames, pooling and number of columns; a column per embodiment."""
    rows = rows_if_measured("scooping_probe")
    what = ("pixels", "pooling", "features", "columns")
    whose = list(dict.fromkeys(row["embodiment"] for row in rows))
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in what), {})[row["embodiment"]] = row["error_mm"]
    body = [[kind[0], f"`{kind[1]}`", *kind[2:], *(errors[who] for who in whose)] for kind, errors in found.items()]
    judged = {row["embodiment"]: f"{row['demonstrations']} + {row['held_out']} demonstrations" for row in rows}
    return table([*what, *(f"{who} (mm), {judged[who]}" for who in whose)], body)


def scooping_probe_errors() -> dict[str, str]:
    """What the task's own embedding keeps: its pooling and columns, and the errors by embodiment (mm)."""
    task = {"pixels": str(IMAGE_SIZE), "pooling": "grid", "columns": str(EMBEDDING_DIM)}
    own = [row for row in rows_if_measured("scooping_probe") if all(row[key] == task[key] for key in task)]
    return task | {row["embodiment"]: row["error_mm"] for row in own}


def scooping_parts_table() -> str:
    """A row per part of the policy that was looked at alone."""
    rows = rows_if_measured("scooping_parts")
    titles = {
        "expert": "the scripted robot",
        "replay": "its joint targets, played among pieces that lie otherwise",
        "controller": "targets decoded from recorded frames, played without looking",
        "planner": "plans of plans from the first frame: the imagined spoon is lifted out",
    }
    body = []
    for row in sorted(rows, key=lambda row: list(titles).index(row["part"])):
        method = f"`{row['method']}`" if row["method"] else ""
        body.append([titles[row["part"]], method, row["unlabelled"], row["n"], percent(row, 0)])
    return table(["part", "method", "unlabelled", "episodes", "succeed"], body)


def scooping_strokes_table() -> str:
    """A row per number of labels, start position and outcome of the rollouts that were played again."""
    body = [
        [row["labels"], row["seed"], row["start"], "yes" if row["success"] == "1" else "no", row["n"]]
        + [
            row[f"{name}_mm"] + (f" +- {row[f'{name}_sd']}" if row[f"{name}_sd"] else "")
            for name in ("entry", "height")
        ]
        + [row["pieces"]]
        for row in rows_if_measured("scooping_strokes")
    ]
    head = ["labelled", "seed", "start", "success", "rollouts", "entry off the usual one (mm)"]
    return table([*head, "height of the stroke (mm)", "pieces on the spoon"], body)


def scooping_alignment_table() -> str:
    """A row per number of robot demonstrations that the hand's are aligned to."""
    found: dict[str, dict[str, Mapping[str, str]]] = {}
    for row in rows_if_measured("scooping_alignment"):
        found.setdefault(row["robots"], {})[row["moved"]] = row
    body = [
        [robots, *(own[way]["error_mm"] for way in ("not at all", "by the means", "aligned"))]
        + [f"{own['aligned']['same_start']} of {own['aligned']['hands']}"]
        for robots, own in found.items()
    ]
    head = ["robot demonstrations", "as they are (mm)", "means moved (mm)", "aligned (mm)", "partners begin alike"]
    return table(head, body)


def scooping_cost_table() -> str:
    """Wall seconds of a cell by part, and their sum in minutes."""
    rows = rows_if_measured("scooping_cost")
    body = [[row["part"], row["what"], row["seconds"], row["source"]] for row in rows]
    total = sum(float(row["seconds"]) for row in rows)
    return table(["part", "what", "seconds", "read from"], [*body, ["together", "", f"{total:.0f}", ""]])


def scooping_minutes() -> str:
    """Minutes that a cell took with everything before it."""
    return f"{sum(float(row['seconds']) for row in rows_if_measured('scooping_cost')) / 60:.0f} minutes"


def scooping_outlines() -> dict[str, str]:
    """How alike the outlines of the two arms are: the row of ``scooping_silhouette.csv``."""
    return rows_if_measured("scooping_silhouette")[0]
