# This source code is licensed under the MIT license found in the LICENSE file.
"""What a task *is*: observation and action columns, goal, modes, how it looks, and which code simulates it.

Code is named by import strings (``"package.module:name"``), so that a task is plain data, which can be written to JSON
beside a data set, and no simulator is imported before it is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

from torch import Tensor

from torchrl_koap.files import dataclass_from_json
from torchrl_koap.lookup import lookup, resolve
from torchrl_koap.tasks.action_rules import Action, ActionRule
from torchrl_koap.tasks.checks import check_task
from torchrl_koap.tasks.columns import Columns
from torchrl_koap.tasks.modes import Modes
from torchrl_koap.tasks.scene import Body, Scene

CONTROL_HZ = 1 / 0.035
# planner and controller see the same window in every task: 2 observed frames, 14 planned ones; 4 actions of each plan
# are executed
HISTORY, HORIZON, REPLAN_INTERVAL = 2, 14, 4
WINDOW = HISTORY + HORIZON


@dataclass(frozen=True)
class Defaults:
    """Settings that are a task's own unless a command gives others.

    Args:
        method (str): what `koap train` trains.
        demonstrations (int): number of scripted demonstrations to record.
        disturbance (float): share of them in which the expert is disturbed.
        relative (bool): plans are displacements from the present state.
        recovery (float, optional): typical shift of the recovery augmentation, in the units of the robot's columns.
            Default: of every column what it usually changes in a control step.
        neighbor_recovery (float): largest displacement of a window towards the nearest other one, as a share of their
            difference; used if no column is a position that could be shifted.
        planner (dict): options of :class:`~torchrl_koap.PlannerConfig`. Its sizes are those of its network alone:
            another one that is asked for by name comes with its own.
        controller (dict): options of :class:`~torchrl_koap.ControllerConfig`; the preset is that of ``method`` alone.
        commands (bool): controllers learn the command that an action leads to, not its change; labels then tell the
            command, and the observation has to repeat it.
        execution (dict): fields of :class:`~torchrl_koap.Execution`.
    """

    method: str = "koap"
    demonstrations: int = 200
    disturbance: float = 0.0
    relative: bool = True
    recovery: float | None = None
    neighbor_recovery: float = 0.0
    planner: Mapping[str, Any] = field(default_factory=dict)
    controller: Mapping[str, Any] = field(default_factory=dict)
    execution: Mapping[str, Any] = field(default_factory=dict)
    commands: bool = False


@dataclass(frozen=True, kw_only=True)
class Task(Columns):
    """Facts of one task (lengths in m, angles in rad, unless a column says otherwise).

    Args:
        name (str): name used on the command line and in files.
        observation_parts (dict): and the other columns, see :class:`~torchrl_koap.tasks.Columns`.
        actions (dict): name of every action column to its :class:`~torchrl_koap.tasks.Action`.
        position (str): the part that pictures draw, ``x, y`` first.
        max_steps (int): control steps after which an episode is truncated.
        control_hz (float): control steps per second.
        robot (tuple of int): state columns of the robot itself, which recovery shifts and the controller reads.
        tool_kinematics (str, optional): import string of the function from the robot's joints ``[*B, J]`` to the
            position of the tool ``[*B, 3]``, where joints are commanded; ``position`` then follows them.
        planar_parts (tuple of str): parts whose positions and yaws may be moved and turned together for training.
        interchangeable (tuple): groups of bodies that may be permuted for training.
        relative_positions (tuple): what the planner reads besides the state: ``(part, seen from part, in the frame of
            part, yaw of part)``, the last two optional (see :meth:`relative_columns`).
        goal (str, optional): import string of the function of the task and a state ``[*B, d]`` that says where it is
            done, bool ``[*B]``.
        modes (Modes): the ways in which the task can be done.
        score (str, optional): import string of a function of the result of
            :func:`~torchrl_koap.evaluation.scores.score`, the episodes and their contexts that returns further figures.
        noise (float): standard deviation of the noise on the measured end effector (m), in demonstrations too.
        env (str, optional): import string of the environment (:mod:`torchrl_koap.envs.registry` says what it has to
            offer). None: a robot with data and no simulator.
        env_options (dict): its further keyword arguments.
        expert (str, optional): import string of the scripted expert (:mod:`torchrl_koap.envs.experts.recording`).
        data_from (str, optional): name of the task whose demonstrations are used, if another one.
        scene (Scene): the bodies that a context places, where they start, and how all looks from above.
        label_levels (tuple of float): shares of labelled windows of the label levels 1, 2, ...
        defaults (Defaults): settings that are the task's own.

    Raises:
        ValueError: with every fault found: a part, column or body that does not exist, columns out of range.

    Examples:
        >>> from torchrl_koap.tasks import Action, Task
        >>> arm = Task(
        ...     name="arm",
        ...     observation_parts={"joints": 7, "cup_xy": ("cup_x", "cup_y")},
        ...     actions={f"joint_{joint}": Action("rad", column=joint - 1) for joint in range(1, 8)},
        ...     position="cup_xy",
        ... )
        >>> arm.action_dim, arm.state_names[-2:], Task.from_json(arm.to_json()) == arm
        (7, ('cup_x', 'cup_y'), True)
    """

    actions: Mapping[str, Action]
    position: str
    max_steps: int = 400
    control_hz: float = CONTROL_HZ
    robot: tuple[int, ...] = ()
    tool_kinematics: str | None = None
    planar_parts: tuple[str, ...] = ()
    interchangeable: tuple[tuple[str, ...], ...] = ()
    relative_positions: tuple[tuple[str, ...], ...] = ()
    goal: str | None = None
    modes: Modes = Modes()
    score: str | None = None
    noise: float = 0.0
    env: str | None = None
    env_options: Mapping[str, Any] = field(default_factory=dict)
    expert: str | None = None
    data_from: str | None = None
    scene: Scene = Scene()
    label_levels: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.25)
    defaults: Defaults = Defaults()

    def __post_init__(self):
        check_task(self)

    @property
    def action_dim(self) -> int:
        """Number of action columns."""
        return len(self.actions)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action columns."""
        return tuple(self.actions)

    @property
    def action_units(self) -> tuple[str, ...]:
        """Units of the action columns."""
        return tuple(action.unit for action in self.actions.values())

    @cached_property
    def delta_actions(self) -> tuple[int, ...]:
        """Action columns that are changes of a command or velocities."""
        return tuple(index for index, action in enumerate(self.actions.values()) if action.kind == "delta")

    @cached_property
    def targets(self) -> dict[int, int]:
        """Action column and state column of each absolute action that names the column that it is the target of."""
        absolute = {index: a.column for index, a in enumerate(self.actions.values()) if a.kind == "absolute"}
        return {index: column for index, column in absolute.items() if column is not None}

    @cached_property
    def moves(self) -> dict[int, int]:
        """Action column of each command and the state column that it moves; empty where that is not known.

        These are the ``targets``, else the changes of a command: they move the columns that the actions name, or where
        some name none the first ones of the robot.
        """
        if self.targets:
            return self.targets
        moved = self.moved_columns() or self.robot[: len(self.delta_actions)]
        known = len(moved) == len(self.delta_actions)
        return dict(zip(self.delta_actions, moved, strict=True)) if known else {}

    @cached_property
    def distances(self) -> tuple[tuple[int, int], ...]:
        """Action column and state column of the actions that controllers learn as the distance from the state.

        These are absolute actions with targets, and commands that move a known column.
        """
        return tuple(self.moves.items()) if self.targets or self.defaults.commands else ()

    @property
    def origins(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """What was subtracted from every observation column and every action; None: nothing."""
        if not self.observation_origin:
            return None
        places = {index: self.observation_origin[self.state_columns[c]] for index, c in self.targets.items()}
        return self.observation_origin, tuple(places.get(index, 0.0) for index in range(self.action_dim))

    @cached_property
    def gripper(self) -> tuple[int, int] | None:
        """Action column of the gripper and state column of its width, None where no width commands one."""
        for index, action in enumerate(self.actions.values()):
            if action.kind == "gripper" and action.column is not None:
                return index, action.column
        return None

    def moved_columns(self) -> tuple[int, ...]:
        """Returns the state column that each action moves; empty where one of them names none, or is its target."""
        columns = [action.column for action in self.actions.values() if action.column is not None]
        return tuple(columns) if len(columns) == self.action_dim and not self.targets else ()

    @property
    def action_rule(self) -> ActionRule | None:
        """What has the last word on decoded actions, None if nothing has."""
        actions = enumerate(self.actions.values())
        constants = {index: action.constant for index, action in actions if action.constant is not None}
        told = self.gripper or self.distances or constants
        return ActionRule(self.gripper, self.distances, constants) if told else None

    @property
    def bodies(self) -> tuple[Body, ...]:
        """What a context places."""
        return self.scene.bodies

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the bodies that a context places."""
        return tuple(body.name for body in self.bodies)

    @property
    def source(self) -> str:
        """Name of the task whose demonstrations are used."""
        return self.data_from or self.name

    @cached_property
    def tool_position(self) -> Callable[[Tensor], Tensor] | None:
        """The function from joints to the position of the tool, None where the tool itself is commanded."""
        return resolve(self.tool_kinematics, f"tool_kinematics of task {self.name!r}")

    @property
    def tool_columns(self) -> tuple[int, ...] | None:
        """State columns of a tool position that follows the joints, None where the tool itself is commanded."""
        if self.tool_kinematics is None:
            return None
        return tuple(range(self.state_dim)[self.state_slices[self.position]])

    @property
    def plans_position(self) -> bool:
        """Whether the state begins with the position that pictures draw."""
        return next(iter(self.state_parts.items())) == (self.position, "plain")

    def controller_columns(self, part: str) -> tuple[int, ...]:
        """Returns the state columns that a controller reads: the ``"robot"``'s, which actions command, or all."""
        everything = tuple(range(self.state_dim))
        parts = {"robot": self.robot or everything, "all": everything, "related": everything}
        return lookup(parts, part, "part of the state")

    def relative_columns(self) -> list[tuple[slice, ...]]:
        """Returns the state columns of ``relative_positions``: a position, another, a yaw, another yaw."""
        return [tuple(self.state_slices[name] for name in names) for names in self.relative_positions]

    def interchangeable_columns(self) -> list[list[list[int]]]:
        """Returns the state columns of the bodies that may be permuted, by group and body."""

        def columns_of(name: str) -> list[int]:
            parts = [part for part in self.state_slices if part.startswith(f"{name}_")]
            return [column for part in parts for column in range(self.state_dim)[self.state_slices[part]]]

        return [[columns_of(name) for name in group] for group in self.interchangeable if len(group) > 1]

    def planar_columns(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Returns the state columns of the positions ``(x, y)`` and yaws ``(cos, sin)`` that move together."""
        columns = self.state_slices
        pairs = {name: (columns[name].start, columns[name].start + 1) for name in self.planar_parts}
        yaws = [name for name in self.planar_parts if self.state_parts[name] == "quaternion"]
        return [pair for name, pair in pairs.items() if name not in yaws], [pairs[name] for name in yaws]

    def goal_reached(self, state: Tensor) -> Tensor:
        """Says in which states, planned or recorded, the task is done: bool ``[*B]`` of states ``[*B, d]``.

        Raises:
            ValueError: if the task has no goal, or the state has another number of columns.
        """
        if self.goal is None:
            raise ValueError(f"task {self.name!r} has no goal: give it one, or judge no states")
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"a state of task {self.name!r} has {self.state_dim} columns, got {state.shape[-1]}")
        return resolve(self.goal, f"goal of task {self.name!r}")(self, state)

    def import_strings(self) -> dict[str, str]:
        """Returns the import strings by the field that has them: the code that using the task may run."""
        named = {field: getattr(self, field) for field in ("env", "expert", "goal", "score")}
        named |= {"tool_kinematics": self.tool_kinematics, "modes.of_path": self.modes.of_path}
        return {place: value for place, value in named.items() if value}

    def to_json(self) -> dict[str, Any]:
        """Returns the task as dictionaries, lists, strings and numbers; an object in place of its name is refused."""
        return {name: _plain(value, name) for name, value in asdict(self).items()}

    def definition(self) -> dict[str, Any] | None:
        """Returns the task as data sets and runs keep it; None if it names code, so that its name has to do."""
        return None if self.import_strings() else self.to_json()

    @classmethod
    def from_json(cls, entries: object) -> Task:
        """Reads the task that :meth:`to_json` wrote; unknown, missing and unfitting entries are refused."""
        return dataclass_from_json(cls, entries)


def _plain(value: Any, place: str) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry, f"{place}.{key}") for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry, place) for entry in value]
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    raise TypeError(f"{place} cannot be written to JSON: wanted an import string, got {value!r}")
