# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes a page per registered task: columns, units, limits, modes, picture, expert, results."""

from __future__ import annotations

import inspect
import math
from typing import Any

from pages import (
    GENERATED,
    benchmark_rows,
    code,
    escape,
    heading,
    measured_table,
    table,
    toctree,
    write_page,
)

from torchrl_koap.envs.registry import IDS
from torchrl_koap.lookup import resolve
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.tasks import Action, Task
from torchrl_koap.tasks.registry import TASKS
from torchrl_koap.training.defaults import resolve as default_config

UNITS = {"quaternion": "1 (quaternion w, x, y, z)", "tan_yaw": "1 (tangent of the yaw)"}


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: (write_task_pages(), write_defaults()))
    return {"parallel_read_safe": True}


def write_task_pages() -> None:
    """Writes ``generated/tasks``: an index, and a page and a picture per task."""
    names = [name for name, task in TASKS.items() if task.env is not None and task.env.startswith("torchrl_koap.")]
    for name in names:
        write_task(TASKS[name])
    rows = [
        (
            f":doc:`{name}`",
            f"{task.observation_dim} / {task.state_dim}",
            ", ".join(
                f"{column} ({unit or '1'})" for column, unit in zip(task.actions, task.action_units, strict=True)
            ),
            task.modes.number,
            f"{task.max_steps} steps, {task.max_steps / task.control_hz:.0f} s",
        )
        for name, task in ((name, TASKS[name]) for name in names)
    ]
    write_page(
        "tasks/index",
        heading("Every task in numbers"),
        "Made from the registry of tasks, ``torchrl_koap/tasks``. What the simulator does, fact by fact, and how it "
        "was compared with the original one: :doc:`/appendix/d3il`.",
        table(("task", "columns observed / planned", "actions", "modes", "limit"), rows),
        toctree(names, hidden=True),
    )


def write_task(task: Task) -> None:
    """Writes the page of one task."""
    draw(task)
    expert = resolve(task.expert, "expert") if task.expert else None
    facts = [
        ("control rate", f"{task.control_hz:.4g} Hz"),
        ("an episode is cut after", f"{task.max_steps} control steps ({task.max_steps / task.control_hz:.1f} s)"),
        ("ends by a collision", "yes" if task.env and resolve(task.env, "env").COLLIDES else "no"),
        ("noise on the measured tool", f"{1e3 * task.noise:g} mm" if task.noise else "none"),
        ("plans are", "displacements" if task.defaults.relative else "positions"),
        (
            "demonstrations, planner updates",
            f"{task.defaults.demonstrations}, {task.defaults.planner.get('steps', 12000):,}",
        ),
        ("Gymnasium id", next((f"``torchrl_koap/{name}``" for name, own in IDS.items() if own == task.name), "none")),
        ("environment", f":class:`~{task.env.replace(':', '.')}`" if task.env else "none"),
        ("scripted expert", f":class:`~{task.expert.replace(':', '.')}`" if task.expert else "none"),
        ("demonstrations are those of", f":doc:`{task.source}`" if task.source != task.name else "this task"),
    ]
    write_page(
        f"tasks/{task.name}",
        heading(task.name),
        f".. image:: {task.name}.png\n   :width: 420\n   :alt: {task.name} from above",
        f"In the pictures of a report: {escape(task.scene.caption.strip())}" if task.scene.caption else "",
        code(
            f"koap demos --task {task.name} --out demos\nkoap train --task {task.name} --out runs/{task.name}", "bash"
        ),
        table(("fact", "value"), facts),
        heading("What is observed", 1),
        table(("column", "part", "unit", "in the state as"), observation_rows(task)),
        heading("What is commanded", 1),
        table(("column", "unit", "limits per step", "kind"), action_rows(task)),
        *mode_blocks(task),
        *body_blocks(task),
        *expert_blocks(expert),
        *measured_blocks(task),
    )


def observation_rows(task: Task) -> list[tuple[str, ...]]:
    """Returns rows of column, part, unit and the state columns made from it."""
    rows = []
    for part, columns in task.observation.items():
        names = task.observation_names[columns]
        kind = task.state_parts.get(part)
        if part == task.command:
            seen = "never: its differences are the actions"
        elif kind is None:
            seen = "hidden"
        else:
            seen = ", ".join(task.state_names[task.state_slices[part]])
        unit = UNITS.get(kind or "", "m" if "xy" in part or "pos" in part else "")
        for index, name in enumerate(names):
            given = task.observation_units[columns][index] if task.observation_units else unit
            rows.append((f"``{name}``", part, given or "rad or 1", seen if index == 0 else ""))
    return rows


def action_rows(task: Task) -> list[tuple[str, ...]]:
    """Returns rows of column, unit, limits of the environment, and whether the action is a change."""
    low, high = action_limits(task)
    rows = []
    for index, (name, unit) in enumerate(zip(task.actions, task.action_units, strict=True)):
        kind = "command itself" if index not in task.delta_actions else "change of the command"
        bounded = low is not None and math.isfinite(low[index]) and math.isfinite(high[index])
        limits = f"{low[index]:.4g} to {high[index]:.4g}" if bounded else "not bounded"
        rows.append((f"``{name}``", unit or "1", limits, kind))
    return rows


def action_limits(task: Task) -> tuple[list[float] | None, list[float] | None]:
    """Returns the bounds in the environment's action specification."""
    from torchrl_koap.envs.registry import make_env

    known = inspect.signature(resolve(task.env, "env").__init__).parameters
    blind = {"embed": False} if "embed" in known else {}  # action bounds need no camera
    env = make_env(task.name, num_envs=1, num_threads=1, **blind)
    space = env.action_spec.space
    env.close()
    if not hasattr(space, "low"):
        return None, None
    return space.low[0].tolist(), space.high[0].tolist()


def mode_blocks(task: Task) -> list[str]:
    """Returns the section on the modes of the task."""
    if not task.modes.choices:
        return []
    names = {"all": "all successful episodes", "contexts": "contexts", "solved_contexts": "contexts with a success"}
    among = names.get(task.modes.entropy, task.modes.entropy)
    return [
        heading(f"{task.modes.number} modes", 1),
        table(("choice", "values"), [(choice, ", ".join(names)) for choice, names in task.modes.choices]),
        f"Their entropy is taken over {among}, to the base {task.modes.number}.",
    ]


def body_blocks(task: Task) -> list[str]:
    """Returns the section on the start regions of bodies."""
    scene = task.scene
    if not scene.varies:
        return []
    low, high = scene.start_yaw
    rows = []
    for index, body in enumerate(task.bodies):
        for (x0, x1), (y0, y1) in scene.starts_of(index):
            rows.append((body.label, f"{x0:g} to {x1:g}", f"{y0:g} to {y1:g}", f"{low:g} to {high:g}"))
    dealt = "Each body gets one of the regions at random." if scene.shared_starts else ""
    return [
        heading("Where the bodies start", 1),
        table(("body", "x (m)", "y (m)", "yaw (deg)"), rows),
        dealt,
        "``koap eval`` takes the 60 contexts of a fixed table, so that two methods meet the same situations.",
    ]


def expert_blocks(expert: Any) -> list[str]:
    """Returns the section on the scripted expert, with the first line of its docstring."""
    if expert is None or not expert.__doc__:
        return []
    return [heading("The expert", 1), expert.__doc__.strip().splitlines()[0]]


def measured_blocks(task: Task) -> list[str]:
    """Returns the success of KOAP, `mpc` and the ridge in the current comparison."""
    shown = ("koap", "mpc", "linear_steps")
    rows = [row for row in benchmark_rows(task=task.name) if row["method"] in shown]
    return [heading("Measured", 1), measured_table(rows, "method"), "More: :doc:`/results`."]


def write_defaults() -> None:
    """Writes ``generated/defaults``: default options of a training for each task and for a user's own data."""
    own = Task(name="your own data", observation_parts={"x": 4}, actions={"u": Action()}, position="x", robot=(0, 1))
    rows = []
    for task in (own, *TASKS.values()):
        config = default_config(TrainConfig(out="unused"), task)
        planner, controller, execution = config.planner, config.controller, config.execution
        size = f"{planner.steps:,} x {planner.batch_size}"
        way = (
            f"{execution.strategy}, {execution.replan_interval}, {execution.blend}, {execution.lead}, {execution.gain}"
        )
        names = (f"``{task.name}``" if task is not own else task.name, config.method, controller.preset)
        rows.append((*names, planner.network, size, planner.learning_rate, controller.steps, way))
    way = "execution: strategy, replan interval, blend, lead, gain"
    head = ("task", "method", "preset", "planner", "updates x batch", "learning rate", "controller updates", way)
    write_page(
        "defaults",
        heading("Defaults by task"),
        "Made from the code. A planner updates at most this often; data of your own stop earlier.",
        table(head, rows),
    )


def draw(task: Task) -> None:
    """Draws the scene from above with the start regions of bodies."""
    path = GENERATED / "tasks" / f"{task.name}.png"
    if path.exists():
        return
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    from torchrl_koap.reports.scenes import color_of, draw_scene

    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(4.6, 4), layout="constrained")
    axes = draw_scene(figure.add_subplot(), task)
    for index, body in enumerate(task.bodies):
        for (x0, x1), (y0, y1) in task.scene.starts_of(index):
            color = color_of(body.color)
            axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, linestyle=":", edgecolor=color))
            x, y = (x0 + x1) / 2, (y0 + y1) / 2
            axes.add_patch(
                Rectangle(
                    (x - body.half[0], y - body.half[1]), 2 * body.half[0], 2 * body.half[1], color=color, alpha=0.6
                )
            )
    axes.autoscale_view()
    figure.savefig(path, dpi=100)
