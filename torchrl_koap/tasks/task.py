# This source code is licensed under the MIT license found in the LICENSE file.
"""Definition of a task: observation and action columns, goal, modes, appearance, and the code that simulates it.

Code is named by import strings (``"package.module:name"``). So a task is plain data that can be written to JSON beside
a data set, and simulators are only imported when used.
"""

from __future__ import annotations

import json
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
# the same window for all tasks: 2 observed frames, 14 planned ones; 4 actions of each plan are executed
HISTORY, HORIZON, REPLAN_INTERVAL = 2, 14, 4
WINDOW = HISTORY + HORIZON


@dataclass(frozen=True)
class Defaults:
    """Default settings of a task, which options of a command override.

    Args:
        method (str): the method that `koap train` trains.
        demonstrations (int): number of scripted demonstrations to record.
        disturbance (float): share of them in which the expert is disturbed.
        relative (bool): plans are displacements from the present state.
        recovery (float, optional): typical shift of the recovery augmentation, in the units of the robot's columns.
            Default: the usual change of each column in a control step, or in 1/30 s if that is longer.
        joint_recovery (float): typical size of the shift drawn in the joints (rad), if ``tool_kinematics`` are given;
            ``recovery`` is then that of the tool (m).
        neighbor_recovery (float): largest displacement of a window towards the nearest other one, as a share of their
            difference; used if no column is a position that could be shifted.
        planner (dict): options of :class:`~torchrl_koap.PlannerConfig`. Sizes apply only to the network given here;
            other networks use their own.
        controller (dict): options of :class:`~torchrl_koap.ControllerConfig`; the preset applies only to ``method``.
        commands (bool): controllers learn the command that results from an action instead of its change. Labels then
            include the command, which the observation must repeat.
        execution (dict): fields of :class:`~torchrl_koap.Execution`.
    """

    method: str = "koap"
    demonstrations: int = 200
    disturbance: float = 0.0
    relative: bool = True
    recovery: float | None = None
    joint_recovery: float = 0.0
    neighbor_recovery: float = 0.0
    planner: Mapping[str, Any] = field(default_factory=dict)
    controller: Mapping[str, Any] = field(default_factory=dict)
    execution: Mapping[str, Any] = field(default_factory=dict)
    commands: bool = False


@dataclass(frozen=True, kw_only=True)
class Task(Columns):
    """Definition of one task (lengths in m, angles in rad, unless a unit is given).

    Args:
        name (str): name on the command line and in files.
        observation_parts (dict): and the other columns, see :class:`~torchrl_koap.tasks.Columns`.
        actions (dict): an :class:`~torchrl_koap.tasks.Action` for the name of every action column.
        position (str): the part that pictures draw, ``x, y`` first.
        max_steps (int): control steps after which an episode is truncated.
        control_hz (float): control steps per second.
        robot (tuple of int): state columns of the robot, which recovery shifts and the controller reads.
        tool_kinematics (str, optional): if joints are commanded, the import string of the function from the robot's
            joints ``[*B, J]`` to the position of the tool ``[*B, 3]``; ``position`` then follows the joints.
        planar_parts (tuple of str): parts whose positions and yaws may be shifted and turned together for training.
        interchangeable (tuple): groups of bodies that may be permuted for training.
        relative_positions (tuple): further inputs of the planner: ``(part, seen from part, in the frame of part, yaw of
            part)``, the last two optional (see :meth:`relative_columns`).
        goal (str, optional): import string of a function of the task and states ``[*B, d]``, which returns whether the
            goal is reached, bool ``[*B]``.
        modes (Modes): the ways in which the task can be done.
        score (str, optional): import string of a function of the result of
            :func:`~torchrl_koap.evaluation.scores.score`, the episodes and their contexts that returns further figures.
        noise (float): standard deviation of the noise on the measured end effector (m), in demonstrations too.
        env (str, optional): import string of the environment, with the interface in :mod:`torchrl_koap.envs.registry`.
            None: a robot with data and no simulator.
        env_options (dict): further keyword arguments of the environment.
        expert (str, optional): import string of the scripted expert (:mod:`torchrl_koap.envs.experts.recording`).
        data_from (str, optional): name of the task whose demonstrations are used. Default: its own.
        scene (Scene): the bodies that a context places, where they start, and the top view.
        label_levels (tuple of float): shares of labelled windows of the label levels 1, 2, ...
        defaults (Defaults): default settings of the task.

    Raises:
        ValueError: listing all faults: parts, columns or bodies that do not exist, columns out of range.

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
        """Action column and target column (in the state) of each absolute action with a target."""
        absolute = {index: a.column for index, a in enumerate(self.actions.values()) if a.kind == "absolute"}
        return {index: column for index, column in absolute.items() if column is not None}

    @cached_property
    def moves(self) -> dict[int, int]:
        """Action column of each command and the state column that it moves; empty if unknown.

        These are the ``targets``, or else the changes of a command. Changes move the columns that they name, or the
        first columns of the robot if one of them names none.
        """
        if self.targets:
            return self.targets
        changes, actions = self.delta_actions, list(self.actions.values())
        named = [column for index in changes if (column := actions[index].column) is not None]
        moved = named if len(named) == len(changes) else self.robot[: len(changes)]
        return dict(zip(changes, moved, strict=True)) if len(moved) == len(changes) else {}

    @cached_property
    def distances(self) -> tuple[tuple[int, int], ...]:
        """Action column and state column of the actions that controllers learn as the distance from the state.

        These are absolute actions with targets, and commands that move a known column.
        """
        return tuple(self.moves.items()) if self.targets or self.defaults.commands else ()

    @property
    def origins(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Offsets subtracted from every observation column and every action; None if there are none."""
        if not self.observation_origin:
            return None
        origin = dict(zip(self.observation_names, self.observation_origin, strict=True))
        places = {index: origin.get(self.state_names[column], 0.0) for index, column in self.targets.items()}
        return self.observation_origin, tuple(places.get(index, 0.0) for index in range(self.action_dim))

    @cached_property
    def gripper(self) -> tuple[int, int] | None:
        """Action column of the gripper and state column of its width; None if no gripper is commanded by a width."""
        for index, action in enumerate(self.actions.values()):
            if action.kind == "gripper" and action.column is not None:
                return index, action.column
        return None

    def moved_columns(self) -> tuple[int, ...]:
        """Returns the state column that each action moves; empty if an action names none, or there are targets."""
        columns = [action.column for action in self.actions.values() if action.column is not None]
        return tuple(columns) if len(columns) == self.action_dim and not self.targets else ()

    @property
    def action_rule(self) -> ActionRule | None:
        """Rule applied to decoded actions; None if there is none."""
        return ActionRule(self.gripper, self.distances) if self.gripper or self.distances else None

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies that a context places."""
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
        """Function from joints to the position of the tool; None if the tool itself is commanded."""
        return resolve(self.tool_kinematics, f"tool_kinematics of task {self.name!r}")

    @property
    def tool_columns(self) -> tuple[int, ...] | None:
        """State columns of a tool position that follows the joints; None if the tool itself is commanded."""
        if self.tool_kinematics is None:
            return None
        return tuple(range(self.state_dim)[self.state_slices[self.position]])

    @property
    def plans_position(self) -> bool:
        """Whether the state begins with the position that pictures draw."""
        return next(iter(self.state_parts.items())) == (self.position, "plain")

    def controller_columns(self, part: str) -> tuple[int, ...]:
        """Returns the state columns that a controller reads: those of the commanded ``"robot"``, or all."""
        everything = tuple(range(self.state_dim))
        parts = {"robot": self.robot or everything, "all": everything, "related": everything}
        return lookup(parts, part, "part of the state")

    def relative_columns(self) -> list[tuple[slice, ...]]:
        """Returns the state columns of ``relative_positions``: two positions and up to two yaws each."""
        return [tuple(self.state_slices[name] for name in names) for names in self.relative_positions]

    def interchangeable_columns(self) -> list[list[list[int]]]:
        """Returns the state columns of the bodies that may be permuted, by group and body."""
        return [[self.body_columns(name) for name in group] for group in self.interchangeable if len(group) > 1]

    def body_columns(self, name: str) -> list[int]:
        """Returns the state columns of a body."""
        parts = (self.state_slices[part] for part in self.body_parts(name))
        return [column for part in parts for column in range(part.start, part.stop)]

    def body_parts(self, name: str) -> list[str]:
        """Returns the parts of the state of a body: their names begin with its name, and with no longer body's name."""
        longer = tuple(f"{other}_" for other in self.objects if other.startswith(f"{name}_"))
        return [part for part in self.state_slices if part.startswith(f"{name}_") and not part.startswith(longer)]

    def planar_columns(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Returns the state columns of the positions ``(x, y)`` and yaws ``(cos, sin)`` of ``planar_parts``."""
        columns = self.state_slices
        pairs = {name: (columns[name].start, columns[name].start + 1) for name in self.planar_parts}
        yaws = [name for name in self.planar_parts if self.state_parts[name] == "quaternion"]
        return [pair for name, pair in pairs.items() if name not in yaws], [pairs[name] for name in yaws]

    def goal_reached(self, state: Tensor) -> Tensor:
        """Returns whether the goal is reached in planned or recorded states ``[*B, d]``, bool ``[*B]``.

        Raises:
            ValueError: if the task has no goal, or the number of state columns is wrong.
        """
        if self.goal is None:
            raise ValueError(f"task {self.name!r} has no goal to check states against: give it one (Task.goal)")
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"a state of task {self.name!r} has {self.state_dim} columns, got {state.shape[-1]}")
        return resolve(self.goal, f"goal of task {self.name!r}")(self, state)

    def import_strings(self) -> dict[str, str]:
        """Returns the import strings by field: the code that the task may run."""
        named = {field: getattr(self, field) for field in ("env", "expert", "goal", "score")}
        named |= {"tool_kinematics": self.tool_kinematics, "modes.of_path": self.modes.of_path}
        return {place: value for place, value in named.items() if value}

    def to_json(self) -> dict[str, Any]:
        """Returns the task as dictionaries, lists, strings and numbers; raises a TypeError for other objects."""
        return json.loads(json.dumps(asdict(self)))

    def definition(self) -> dict[str, Any] | None:
        """Returns the task as stored in data sets and runs; None if it names code: only its name is stored then."""
        return None if self.import_strings() else self.to_json()

    @classmethod
    def from_json(cls, entries: object) -> Task:
        """Reads the task that :meth:`to_json` wrote; refuses unknown, missing and invalid entries.

        An action's ``constant`` is ignored: labels of the budget tell which actions are constant.
        """
        if isinstance(entries, Mapping) and isinstance(entries.get("actions"), Mapping):
            actions = {name: entry for name, entry in entries["actions"].items() if isinstance(entry, Mapping)}
            kept = {name: {key: entry[key] for key in entry if key != "constant"} for name, entry in actions.items()}
            entries = {**entries, "actions": {**entries["actions"], **kept}}
        return dataclass_from_json(cls, entries)
