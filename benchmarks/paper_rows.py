# This source code is licensed under the MIT license found in the LICENSE file.
"""Formats committed cells of `koap bench` as tables of docs/results, compared with the paper's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tables import METHOD_NAMES, percent, read_rows, share, success_interval, table

from torchrl_koap.modules import Execution
from torchrl_koap.studies.paper import (
    Entry,
    above_the_paper,
    draw_average,
    layout_rows,
    paper_cells,
    paper_entries,
)
from torchrl_koap.studies.study import PAPER_TASKS
from torchrl_koap.studies.table import as_markdown
from torchrl_koap.tasks import get_task
from torchrl_koap.training.defaults import CONTROLLER_UPDATES
from torchrl_koap.training.methods import get_method

_PLURAL = {"window": "windows", "trajectory": "trajectories"}


def read_cells(name: str) -> list[dict[str, Any]]:
    """Reads all cells of a comparison; numbers are converted, empty entries become None."""
    return [{column: _value(text) for column, text in row.items()} for row in read_rows(f"cells/{name}")]


def _value(text: str) -> Any:
    try:
        return int(text) if text.lstrip("-").isdigit() else float(text)
    except ValueError:
        return text or None


def finished_cells(name: str) -> list[dict[str, Any]]:
    """Returns the finished cells of a comparison."""
    return [row for row in read_cells(name) if row["status"] == "done"]


def paper_cells_beside(name: str) -> list[Entry]:
    """Pairs the cells of a comparison with the paper's; includes cells that were not run."""
    return paper_entries(read_cells(name))


def paper_levels_table() -> str:
    """Formats the shares of labels at the paper's levels, by task."""
    body = [[f"`{task}`", *map(share, get_task(task).label_levels)] for task in PAPER_TASKS]
    return table(["task", *(f"level {level}" for level in range(1, 6))], body)


def bench_table(name: str) -> str:
    """Formats the cells of a comparison file in the layout of the paper's tables, each with the paper's value."""
    return as_markdown(layout_rows(paper_entries(read_cells(name))))


def observation_table(name: str) -> str:
    """Formats success in percent over all seeds: a row per known share of the trajectories, a column per method.

    Args:
        name (str): file of cells without its ending.
    """
    found = count_by_observations(name)
    methods = list(dict.fromkeys(method for own in found.values() for method in own))
    body = [
        [share(part), *(percent(own[method]) if method in own else "not run" for method in methods)]
        for part, own in sorted(found.items())
    ]
    return table(["demonstrations", *(f"`{method}`" for method in methods)], body)


def count_by_observations(name: str) -> dict[float, dict[str, Counter[str]]]:
    """Counts successes and rollouts over all seeds, by share of the trajectories and method."""
    found: dict[float, dict[str, Counter[str]]] = {}
    for row in finished_cells(name):
        counts = found.setdefault(row["demonstrations"], {}).setdefault(row["method"], Counter())
        counts.update(successes=row["successes"], n=row["episodes"])
    return found


def bench_entropy(name: str, method: str, observations: float) -> str:
    """Formats a method's mean mode entropy over the seeds at a share of the trajectories."""
    found = [
        row["mode_entropy"]
        for row in finished_cells(name)
        if row["method"] == method and row["demonstrations"] == observations and row["mode_entropy"] is not None
    ]
    return f"`{sum(found) / len(found):.2f}`"


def paper_size() -> str:
    """Returns the number of cells in the paper's tables."""
    return str(sum(cell.task != "stacking_1" for number in (1, 2) for cell in paper_cells(number)))


def bench_sentence(name: str) -> str:
    """Counts the cells in which KOAP is above the paper's KOAP."""
    above, both = above_the_paper(paper_cells_beside(name))
    return f"{above} of {both}"


def draw_bench_average(name: str, path: Path) -> Path:
    """Draws success averaged over the tasks on which KOAP was run at every level."""
    entries = paper_cells_beside(name)
    gaps = {entry.task for entry in entries if entry.method == "koap" and entry.success is None}
    draw_average([entry for entry in entries if entry.task not in gaps], path)
    return path


def few_labels_table(name: str, all_labels: str, human: str) -> str:
    """Formats success with the fewest labels over all seeds: a row per task, a column per method.

    The last column is Diffusion Policy with all labels.

    Args:
        name (str): file of cells without its ending.
        all_labels (str): file of Diffusion Policy with all labels.
        human (str): file of the last row: human recordings of Avoiding, one of them labelled.
    """
    methods, body = ("koap", "koap_untrained", "linear_steps", "dd", "dp"), []
    for task in PAPER_TASKS:
        fewest = label_shares(name, task)[0]
        text = [_pooled(name, task, method) for method in methods]
        called = task.replace("po_", "partially observed ").replace("_unobserved_joints", ", joints hidden")
        body.append([called.capitalize(), share(fewest), *text, _pooled(all_labels, task, "dp", 1.0)])
    text = [_pooled(human, "avoiding", method) for method in methods]
    body.append(["Avoiding, human recordings", "1 recording", *text, "not run"])
    names = [METHOD_NAMES[method] for method in methods]
    return table(["task", "labelled", *names, "Diffusion Policy, all labels"], body)


def bench_rollouts(name: str) -> str:
    """Returns KOAP's rollouts over all seeds with the fewest labels, the largest number of any task."""
    return str(max(count_successes(name, task, "koap", label_shares(name, task)[0])["n"] for task in PAPER_TASKS))


def label_shares(name: str, task: str) -> list[float]:
    """Returns the shares of labels of a task, smallest first."""
    return sorted({row["labels"] for row in finished_cells(name) if row["task"] == task})


def count_successes(name: str, task: str, method: str, labels: float) -> Counter[str]:
    """Counts successes and rollouts of a method over all seeds."""
    counts: Counter[str] = Counter()
    for row in finished_cells(name):
        if (row["task"], row["method"], row["labels"]) == (task, method, labels):
            counts.update(successes=row["successes"], n=row["episodes"])
    return counts


def _pooled(name: str, task: str, method: str, labels: float | None = None) -> str:
    """Formats success over all seeds in whole percent with its Wilson interval. Default: the fewest labels."""
    counts = count_successes(name, task, method, labels or label_shares(name, task)[0])
    if not counts["n"]:
        return "not run"
    return "{:.0f} ({:.0f}-{:.0f})".format(*success_interval(counts["successes"], counts["n"]))


def bench_size(name: str) -> str:
    """Formats seeds, rollouts and unit of the labels of a comparison, as found in its cells."""
    cells = finished_cells(name)
    seeds, episodes, units = ({row[part] for row in cells} for part in ("seed", "episodes", "label_unit"))
    rollouts = " or ".join(map(str, sorted(episodes)))
    trained = "1 training seed" if len(seeds) == 1 else f"up to {len(seeds)} training seeds"
    return (
        f"{len(cells)} runs, {trained}, {rollouts} rollouts each, {'/'.join(_PLURAL[unit] for unit in units)} labelled"
    )


@dataclass(frozen=True)
class Setting:
    """Execution, updates and mean score of a method over the tuning tasks; 0 updates: fitted in closed form."""

    execution: str
    updates: int
    score: float

    @property
    def text(self) -> str:
        """Formats the setting."""
        updates = f", {self.updates}" if self.updates else ""
        return f"{self.execution.replace('_', ' ')}{updates}: {self.score:.2f}"


def tuned_settings(method: str) -> list[Setting]:
    """Returns a method's settings scored on every tuning task and number of labels, best first."""
    found: dict[tuple[str, int], list[float]] = {}
    for row in read_rows("method_tuning", method=method):
        updates = int(row["updates"]) if get_method(method).phases else 0
        found.setdefault((row["execution"], updates), []).append(float(row["score"]))
    most = max(map(len, found.values()))
    whole = [Setting(*setting, sum(scores) / most) for setting, scores in found.items() if len(scores) == most]
    return sorted(whole, key=lambda setting: -setting.score)


def declared_setting(method: str) -> Setting:
    """Returns the setting that a method declares, or else the library's default.

    Raises:
        LookupError: if the tuning does not include that setting.
    """
    known = get_method(method)
    execution = Execution().replaced(**known.execution)
    as_planned = "_as_planned" if execution.strategy == "open_loop" and execution.blend == 0 else ""
    wanted = execution.strategy + as_planned, (known.updates or CONTROLLER_UPDATES) if known.phases else 0
    for setting in tuned_settings(method):
        if (setting.execution, setting.updates) == wanted:
            return setting
    raise LookupError(f"{method}: the tuning table has no setting {wanted}")


def tuning_table() -> str:
    """Formats a row per method: its declared setting, and the best one with another execution."""
    body = []
    for method in dict.fromkeys(row["method"] for row in read_rows("method_tuning")):
        own = declared_setting(method)
        other = next(each for each in tuned_settings(method) if each.execution != own.execution)
        body.append([f"`{method}`", own.text, other.text])
    return table(["method", "used", "best other execution"], body)


RIVALS = ("koap_untrained", "linear_steps", "nonlinear", "dd_lookahead", "dd", "lapo", "dp")


def comparison_table() -> str:
    """Formats KOAP's success with the fewest labels minus that of others, in points, paired by context."""
    body = []
    for task in PAPER_TASKS:
        rows = read_rows("cells/comparisons", task=task)
        fewest = min((float(row["labels"]) for row in rows), default=0.0)
        found = {row["method"]: row for row in rows if float(row["labels"]) == fewest and row["difference"]}
        if found:
            body.append([f"`{task}`", *(_points(found[name]) if name in found else "not paired" for name in RIVALS)])
    return table(["KOAP minus", *(METHOD_NAMES[method] for method in RIVALS)], body)


def _points(row: Mapping[str, str]) -> str:
    mean, low, high = (100 * float(row[name]) for name in ("difference", "low", "high"))
    return f"{mean:+.0f} ({low:+.0f} to {high:+.0f})"


def compared(method: str) -> str:
    """Counts cells in which KOAP is above, equal to and below a method by paired 95 % intervals: "3/4/0"."""
    rows = [row for row in read_rows("cells/comparisons", method=method) if row["difference"]]
    above, below = sum(float(row["low"]) > 0 for row in rows), sum(float(row["high"]) < 0 for row in rows)
    return f"{above}/{len(rows) - above - below}/{below}"
