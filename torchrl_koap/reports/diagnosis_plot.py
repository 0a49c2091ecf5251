# This source code is licensed under the MIT license found in the LICENSE file.
"""Picture of `koap inspect`: who reaches the goal, and how execution leaves the plans."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.style import BLUE, INK, MUTED, ORANGE, PALE_BLUE, save_figure, set_title, tidy
from torchrl_koap.tasks import Task, get_task

EXPERIMENTS = {
    "imagined": "planner alone\n(imagined)",
    "followed": "controller alone\n(recorded states)",
    "closed_loop": "both\n(closed loop)",
}


@picture(
    "inspect.png",
    source="inspect.json",
    title="Which part fails",
    caption="Success of the planner's own imagination, of the controller on recorded states, and of both in closed"
    " loop; distances of executed states to plans.",
    place=70,
)
def _draw_inspection(result: Mapping[str, Any], path: Path, *, task: str | None) -> Path:
    if "closed_loop" not in result or task is None:
        raise NothingToDraw("the experiments in the simulator were left out")
    return plot_inspection(result, get_task(task), path)


def plot_inspection(result: Mapping[str, Any], task: Task, path: str | Path) -> Path:
    """Success of planner, controller and both, and the distance from plan to execution for each part of the state.

    Args:
        result (mapping): content of ``inspect.json``.
        task (Task): the task.
        path (str or Path): png to write.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.diagnosis_plot import EXPERIMENTS, plot_inspection
        >>> from torchrl_koap.tasks import get_task
        >>> result = {name: {"rate": 0.5, "low": 0.2, "high": 0.8, "episodes": 9} for name in EXPERIMENTS}
        >>> result |= {"plan_to_execution": {"measured_xy": [0.001, 0.002]}, "recording_to_execution": {}}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_inspection(result, get_task("avoiding"), f"{folder}/inspect.png").name
        'inspect.png'
    """
    figure = Figure(figsize=(9.8, 4.1), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    made = {name: words for name, words in EXPERIMENTS.items() if name in result}
    for index, name in enumerate(made):
        value = result[name]
        left.bar(index, 100 * value["rate"], width=0.6, color=BLUE if name == "closed_loop" else PALE_BLUE)
        left.vlines(index, 100 * value["low"], 100 * value["high"], color=INK, linewidth=1.4)
    numbers = [f"{words}\nn = {result[name]['episodes']}" for name, words in made.items()]
    left.set_xticks(range(len(made)), numbers, fontsize=8)
    left.set_ylim(0, 105)
    left.set_ylabel("success (%)")
    set_title(left, "Who reaches the goal (95 % intervals)")
    tidy(left)
    for key, color, label in (
        ("plan_to_execution", ORANGE, "from the plan"),
        ("recording_to_execution", MUTED, "from the recording, when that is the plan"),
    ):
        values = {name: errors[-1] for name, errors in result[key].items()}
        offset = 0.18 if key == "plan_to_execution" else -0.18
        rows = [index + offset for index in range(len(values))]
        right.barh(rows, list(values.values()), height=0.34, color=color, label=label)
    names = list(result["plan_to_execution"])
    right.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=8)
    right.invert_yaxis()
    right.set_xlabel("root mean square distance after the last step of a plan\n(m, rad, or on the unit circle)")
    set_title(right, "How far execution is")
    if names:
        right.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.24), ncols=2)
    tidy(right)
    return save_figure(figure, path)
