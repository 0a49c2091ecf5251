# This source code is licensed under the MIT license found in the LICENSE file.
"""What a task *is*: observation and action columns, goal, modes, how it looks, and which code simulates it.

Environments, readers of recorded data, training and reports share these facts, so they live in none of them. Code is
named by import strings (``"package.module:name"``), so that a task is plain data: it can be written to JSON beside a
data set, and neither simulator nor torch is imported before they are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from torchrl_koap.lookup import lookup
from torchrl_koap.tasks.checks import check_task
from torchrl_koap.tasks.import_strings import resolve
from torchrl_koap.tasks.scene import Body, Scene, StartRegions
from torchrl_koap.tasks.state_parts import StateParts

if TYPE_CHECKING:
    from torch import Tensor

    from torchrl_koap.tasks.relative_positions import RelativePositionFeatures

CONTROL_HZ = 1 / 0.035
# what wins on the tasks with objects: capacity and many samples (docs/results/planners.md)
WIDE_MLP = {
    "denoiser": "mlp",
    "denoiser_width": 512,
    "denoiser_depth": 4,
    "condition_octaves": 1,
    "batch_size": 512,
    "planner_learning_rate": 1e-3,
}
# planner and controller see the same window in every task: 2 observed frames, 14 planned ones; 4 actions of each plan
# are executed
HISTORY, HORIZON, REPLAN_INTERVAL = 2, 14, 4
WINDOW = HISTORY + HORIZON


@dataclass(frozen=True)
class Modes:
    """The ways in which a task can be done.

    Args:
        choices (tuple): what a mode is made of, slowest digit first: ``(choice, names of its values)`` each.
        index (str): import string of the function from the leaf ``mode`` ``[*B, ...]`` to the number of the mode
            ``[*B]``, int64, -1 while it is not decided.
        entropy (str): over which episodes the entropy of the modes is taken: ``"all"`` successful ones together, or
            per context and then averaged over ``"contexts"`` or ``"solved_contexts"`` (those with a success).

    Examples:
        >>> from torchrl_koap.tasks import Modes
        >>> Modes((("row 1", ("left", "right")), ("row 2", ("left", "middle", "right")))).number
        6
    """

    choices: tuple[tuple[str, tuple[str, ...]], ...] = ()
    index: str | None = None
    entropy: str = "all"

    @property
    def number(self) -> int:
        """Number of modes; 1 where nothing is to choose."""
        return math.prod(len(names) for _, names in self.choices)


@dataclass(frozen=True)
class Defaults:
    """Settings that are a task's own unless a command gives others.

    Args:
        method (str): what `koap train` trains.
        preset (str, optional): of that method, where none is asked for. Default: the method's own.
        demonstrations (int): number of scripted demonstrations to record.
        disturbance (float): share of them in which the operator is disturbed.
        planner_steps (int): planner updates.
        channels (tuple of int): widths of the planner's U-Net.
        relative (bool): plans are displacements from the present state.
        recovery_sigma (float): typical shift of the recovery augmentation, in the units of the robot's columns.
        planner (dict): options of `koap train` for the planner's network and its training that are used together where
            no denoiser is asked for: ``denoiser``, its sizes, ``batch_size``, ``planner_learning_rate``.
        recovery_response (str): how that augmentation leads back, ``"first_order"`` or ``"second_order"``.
        view (dict): options of `koap train` for what the planner sees: ``observed_frames``, ``neighbor_recovery``, ...
        released_epochs (int): epochs of a controller in KOAP's first public code.
        execution (dict): options of :class:`~torchrl_koap.evaluation.EvalConfig` for how plans are followed.

    Examples:
        >>> from torchrl_koap.tasks.task import Defaults
        >>> Defaults(demonstrations=50, relative=False).planner_steps
        12000
    """

    method: str = "koap"
    preset: str | None = None
    demonstrations: int = 200
    disturbance: float = 0.0
    planner_steps: int = 12000
    channels: tuple[int, ...] = (64, 128)
    relative: bool = True
    recovery_sigma: float = 0.004
    recovery_response: str = "first_order"
    planner: Mapping[str, Any] = field(default_factory=dict)
    view: Mapping[str, Any] = field(default_factory=dict)
    released_epochs: int = 400
    execution: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Task(StateParts):
    """Facts of one task (lengths in m, angles in rad, unless a column says otherwise).

    Args:
        name (str): name used on the command line and in files.
        observation_parts (dict): parts of the observation in the order of the columns: a number of columns, or their
            names. Numbered ones are called as the part, with a number if it has several.
        actions (dict): unit of every action column, such as ``"m"``, ``"rad"``, ``"N"`` or ``""``.
        position (str): the part that pictures draw, ``x, y`` first.
        max_steps (int): control steps after which an episode is truncated.
        control_hz (float): control steps per second.
        command (str, optional): the part that repeats the last command. Its differences *are* the actions, so it is
            never shown to planner or controller. None: the observation holds no command.
        observation_units (tuple of str): unit of every observation column; empty: m for positions, rad for angles.
        action_targets (tuple of int): for absolute actions the state column that each one is the target of: controllers
            then decode the distance to it. Empty: actions are changes, velocities or efforts.
        absolute_actions (tuple of str): trailing action columns that are commands themselves, not changes of one.
        state (dict): part of the observation to name of its feature (:mod:`torchrl_koap.tasks.features`) or its import
            string, in the order of the state. Empty: every part but the command and the hidden ones, unchanged.
        hidden (tuple of str): further parts that planner and controller must not see.
        actuated (tuple of int): for every action column the state column that it moves, by the same filter for all;
            empty if there is none.
        robot (tuple of int): state columns of the robot itself: the recovery augmentation shifts them, and the
            controller reads them (see :meth:`controller_columns`).
        tool_kinematics (str, optional): import string of the function from the robot's joints ``[*B, J]`` to the
            position of the tool ``[*B, 3]``, where joints are commanded; ``position`` then follows them.
        gripper (tuple of int, optional): action column of the gripper and state column of its width: its number is read
            off the planned widths (:mod:`torchrl_koap.tasks.gripper`), not decoded.
        planar_parts (tuple of str): parts whose positions and yaws may be moved and turned together for training;
            empty if the place on the table matters.
        interchangeable (tuple): groups of bodies that may be permuted for training.
        relative_positions (tuple): what the planner is told besides the state: ``(part, seen from part, in the frame of
            part, yaw of part)``, the last two optional (:mod:`torchrl_koap.tasks.relative_positions`).
        goal (str, optional): import string of the function of the task and a state ``[*B, d]`` that says where it is
            done, bool ``[*B]``.
        modes (Modes): the ways in which the task can be done.
        score (str, optional): import string of a function of the result of
            :func:`~torchrl_koap.evaluation.scores.score`, the episodes and their contexts that returns further figures.
        bodies (tuple of Body): what a context places: bodies that start elsewhere in every episode.
        start_regions (StartRegions, optional): where they start.
        collides (bool): an episode can end by a collision.
        noise (float): standard deviation of the noise on the measured end effector (m), in rollouts and on the
            demonstrations as they are loaded.
        env (str, optional): import string of the environment (:mod:`torchrl_koap.envs.registry` says what it has to
            offer). None: a robot with data and no simulator.
        env_options (dict): its further keyword arguments.
        expert (str, optional): import string of the scripted expert (:mod:`torchrl_koap.envs.experts.recording`).
        expert_options (dict): its further keyword arguments.
        gym_id (str): name with Gymnasium, such as ``"torchrl_koap/Avoiding-v0"``; empty: none.
        data (str): name of the task whose demonstrations are used, if another one.
        converter (str, optional): import string of the :class:`~torchrl_koap.data.Converter` of D3IL's raw pickles.
        scene (Scene): how it looks from above.
        label_levels (tuple of float): shares of labelled windows of the label levels 1, 2, ...
        in_paper (bool): the paper compares its methods on it.
        defaults (Defaults): settings that are the task's own.

    Raises:
        ValueError: with every fault found: a part, column or body that does not exist, columns out of range.

    Examples:
        >>> from torchrl_koap.tasks import Task
        >>> arm = Task(
        ...     name="arm",
        ...     observation_parts={"joints": 7, "cup_xy": ("cup_x", "cup_y")},
        ...     actions={f"joint_{joint}": "rad" for joint in range(1, 8)},
        ...     position="cup_xy",
        ... )
        >>> arm.action_dim, arm.state_names[-2:], Task.from_json(arm.to_json()) == arm
        (7, ('cup_x', 'cup_y'), True)
    """

    name: str
    observation_parts: Mapping[str, int | tuple[str, ...]]
    actions: dict[str, str]
    position: str
    max_steps: int = 400
    control_hz: float = CONTROL_HZ
    command: str | None = None
    observation_units: tuple[str, ...] = ()
    action_targets: tuple[int, ...] = ()
    absolute_actions: tuple[str, ...] = ()
    state: dict[str, str] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    actuated: tuple[int, ...] = ()
    robot: tuple[int, ...] = ()
    tool_kinematics: str | None = None
    gripper: tuple[int, int] | None = None
    planar_parts: tuple[str, ...] = ()
    interchangeable: tuple[tuple[str, ...], ...] = ()
    relative_positions: tuple[tuple[str, ...], ...] = ()
    goal: str | None = None
    modes: Modes = Modes()
    score: str | None = None
    bodies: tuple[Body, ...] = ()
    start_regions: StartRegions | None = None
    collides: bool = False
    noise: float = 0.0
    env: str | None = None
    env_options: dict[str, Any] = field(default_factory=dict)
    expert: str | None = None
    expert_options: dict[str, Any] = field(default_factory=dict)
    gym_id: str = ""
    data: str = ""
    converter: str | None = None
    scene: Scene = Scene()
    label_levels: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.25)
    in_paper: bool = False
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
    def action_unit(self) -> str:
        """Unit of the first action column: that of the columns :meth:`action_columns` returns by default."""
        return next(iter(self.actions.values()))

    def action_columns(self, unit: str | None = None) -> list[int]:
        """Action columns in one unit, whose errors may be averaged.

        Args:
            unit (str, optional): the unit. Default: that of the first column.
        """
        unit = self.action_unit if unit is None else unit
        return [index for index, own in enumerate(self.actions.values()) if own == unit]

    @property
    def num_delta_actions(self) -> int:
        """Number of leading action columns that are changes of a command."""
        return self.action_dim - len(self.absolute_actions)

    @property
    def action_rule(self) -> Callable[[Tensor, Tensor], Tensor] | None:
        """What has the last word on decoded actions (:mod:`torchrl_koap.tasks.action_rules`), None if nothing has."""
        if self.gripper is None and not self.action_targets:
            return None
        from torchrl_koap.tasks.action_rules import ActionRule

        return ActionRule(self.gripper, self.action_targets)

    @property
    def num_modes(self) -> int:
        """Number of modes, base of the logarithm of their entropy."""
        return self.modes.number

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the bodies that a context places."""
        return tuple(body.name for body in self.bodies)

    @property
    def plotted(self) -> dict[str, str]:
        """Body to the part of the observation with its ``x, y``."""
        return {body.name: body.position for body in self.bodies}

    @property
    def source(self) -> str:
        """Name of the task whose demonstrations are used."""
        return self.data or self.name

    @cached_property
    def tool_position(self) -> Callable[[Tensor], Tensor] | None:
        """The function from joints to the position of the tool, None where the tool itself is commanded."""
        return resolve(self.tool_kinematics, f"tool_kinematics of task {self.name!r}")

    def goal_reached(self, state: Tensor) -> Tensor:
        """Which states, planned or recorded, are ones in which the task is done.

        Environments judge the physics; this judges states as planner and controller see them, so that a plan can be
        judged without executing it.

        Args:
            state (Tensor): ``[*B, d]``, see :meth:`state_of`.

        Returns:
            Tensor: bool ``[*B]``.

        Raises:
            ValueError: if the task has no goal, or the state has another number of columns.

        Examples:
            >>> import torch
            >>> from torchrl_koap.tasks import get_task
            >>> get_task("avoiding").goal_reached(torch.tensor([[0.5, 0.36], [0.5, 0.2]]))
            tensor([ True, False])
        """
        if self.goal is None:
            raise ValueError(f"task {self.name!r} has no goal: give it one, or judge no states")
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"a state of task {self.name!r} has {self.state_dim} columns, got {state.shape[-1]}")
        return resolve(self.goal, f"goal of task {self.name!r}")(self, state)

    def controller_columns(self, part: str) -> tuple[int, ...]:
        """State columns that a controller reads.

        Args:
            part (str): ``"robot"``: the robot's own, whose motion the actions command; ``"all"``: the whole state, as
                KOAP's configurations have it.

        Raises:
            ValueError: for another part.
        """
        everything = tuple(range(self.state_dim))
        return lookup({"robot": self.robot or everything, "all": everything}, part, "part of the state")

    def planner_features(self) -> RelativePositionFeatures | None:
        """The task's relative positions as a module, None if it has none."""
        if not self.relative_positions:
            return None
        from torchrl_koap.tasks.relative_positions import RelativePosition, RelativePositionFeatures

        columns = self.state_slices
        return RelativePositionFeatures(
            [RelativePosition(*(columns[name] for name in names)) for names in self.relative_positions]
        )

    def to_json(self) -> dict[str, Any]:
        """The task as plain JSON types (:func:`~torchrl_koap.tasks.json_format.task_to_json`)."""
        from torchrl_koap.tasks.json_format import task_to_json

        return task_to_json(self)

    @classmethod
    def from_json(cls, entries: dict[str, Any]) -> Task:
        """The task that :meth:`to_json` wrote (:func:`~torchrl_koap.tasks.json_format.task_from_json`)."""
        from torchrl_koap.tasks.json_format import task_from_json

        return task_from_json(entries)
