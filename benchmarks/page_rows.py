# This source code is licensed under the MIT license found in the LICENSE file.
"""The one table of each page in docs/results, and the times that its commands took."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from paper_rows import count_by_observations, count_successes, finished_cells, label_shares, paper_cells_beside
from scooping_rows import scooping_cells
from tables import SOURCE, fact, percent, planner_rows, pooled_rewards, read_rows, table
from unlabelled_rows import REGIMES, followed

from torchrl_koap.studies.paper import default_entries


def rate(rows: Sequence[Mapping[str, str]]) -> str:
    """Formats the success of several rows together in whole percent, with its interval."""
    return percent({key: sum(int(row[key]) for row in rows) for key in ("successes", "n")}, 0)


def bench_rate(name: str, task: str, method: str, level: int = 0) -> str:
    """Formats the success of all seeds of a method in whole percent; level 0 has the fewest labels."""
    return percent(count_successes(name, task, method, label_shares(name, task)[level]), 0)


def hours(name: str) -> str:
    """Formats how long the controllers and rollouts of a comparison took, on one core each."""
    seconds = sum(float(row[part] or 0) for row in finished_cells(name) for part in ("train_seconds", "eval_seconds"))
    return f"{seconds / 3600:.1f} core hours for controllers and rollouts, planners apart"


def minutes(name: str, column: str) -> str:
    """Formats the sum of a column of seconds in minutes; rows that share a training are counted once."""
    found = {(row.get("seed"), row[column]) for row in read_rows(name)}
    return f"{sum(float(seconds) for _, seconds in found) / 60:.0f} core minutes of training"


def paper_success_table(name: str) -> str:
    """Formats a row per task and method: success of ours and of the paper's KOAP, a column per label level."""
    entries = paper_cells_beside(name)
    rows: dict[tuple[str, str], dict[int, str]] = {}
    for entry in [*(each for each in entries if each.method == "koap"), *default_entries(entries)]:
        if entry.method != "koap" and entry.task != "stacking_unobserved_joints":
            continue
        called = "`koap`" if entry.method == "koap" else "`command_regression`"
        cell = f"{100 * entry.success:.0f} / {100 * entry.paper.success:.0f}"
        rows.setdefault((f"`{entry.task}`", called), {})[entry.level] = cell
    body = [[*names, *(cells[level] for level in sorted(cells))] for names, cells in rows.items()]
    return table(["task", "method", *(f"level {level}" for level in range(1, 6))], body)


def controllers_table() -> str:
    """Formats success of KOAP and of another controller behind the same planner."""
    body = []
    for task, other, text in (
        ("avoiding", "mpc", "1 trajectory"),
        ("stacking", "mpc", "1 % of windows"),
    ):
        found = (planner_rows(task, method) for method in ("koap", other))
        body.append([f"`{task}`", text, *(f"{rate(rows)} of {sum(int(row['n']) for row in rows)}" for rows in found)])
        body[-1].insert(3, f"`{other}`")
    cells = [
        count_successes("table_1", "stacking_unobserved_joints", name, 0.01) for name in ("koap", "command_regression")
    ]
    told = [f"{percent(counts, 0)} of {counts['n']}" for counts in cells]
    body.append(["`stacking_unobserved_joints`", "1 % of windows", told[0], "`command_regression`", told[1]])
    return table(["task", "labelled", "KOAP", "other controller", "its success"], body)


FOLLOWED = {
    "random features": "koap_untrained",
    "principal components": "pca",
    "`koap`": "koap",
    "`semi_supervised`": "semi_supervised",
}


def followed_table(labels: int, regimes: Sequence[str]) -> str:
    """Formats how often held-out demonstrations were followed: a row per observation model, a column per method.

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
    """Formats success by bowl, labelled demonstrations and unlabelled videos; Diffusion Policy reads labelled ones."""
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
    """Formats action errors by number of labelled demonstrations, and what criteria differ from random choice."""
    rows = read_rows("label_suggestions")
    criteria = list(dict.fromkeys(row["criterion"] for row in rows))
    body = []
    for chosen in dict.fromkeys(row["chosen"] for row in rows):
        mine = {row["criterion"]: row for row in rows if row["chosen"] == chosen}
        body.append([chosen, mine[criteria[0]]["random_error"]])
        body[-1] += [
            "{error}; {difference} ({difference_low} to {difference_high})".format(**mine[name]) for name in criteria
        ]
    return table(["labelled", "random", *(f"`{name}`; difference" for name in criteria)], body)


def speed_table() -> str:
    """Formats what a user waits for: training, plans and environments."""
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


def planner_minutes(task: str, method: str) -> str:
    """Formats how long each planner of a task was trained."""
    seconds = [float(row["train_seconds"]) for row in planner_rows(task, method) if row["train_seconds"]]
    return f"{max(seconds) / 60:.0f} minutes of training"


def observation_rate(name: str, method: str, part: float) -> str:
    """Formats the success of a method with a share of the demonstrations."""
    return percent(count_by_observations(name)[part][method], 0)


def followed_rollouts(labels: int, regimes: Sequence[str]) -> str:
    """Formats the rollouts of an entry of :func:`followed_table`."""
    rows = [row for regime in regimes for row in read_rows("unlabelled_rollouts", regime=regime, labels=labels)]
    sizes: dict[tuple[str, str], int] = {}
    for row in rows:
        cell = row["regime"], row["method"]
        sizes[cell] = sizes.get(cell, 0) + int(row["n"])
    return " or ".join(map(str, sorted({size for (_, name), size in sizes.items() if name in FOLLOWED.values()})))


def mean_reward(ground: str, method: str, execution: str = "default") -> str:
    """Formats the mean largest reward of a method on a proving ground, all training seeds together."""
    ((_, mean, _),) = pooled_rewards(ground=ground, method=method, execution=execution)
    return f"{mean:.2f}"


def requirement(name: str) -> str:
    """Reads which versions of a package pyproject.toml asks for."""
    text = (SOURCE.parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    return re.search(rf'"({name}[<>=][^"]*)"', text)[1]
