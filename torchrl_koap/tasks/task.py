# This source code is licensed under the MIT license found in the LICENSE file.
"""What a task *is* for learning code: observation columns, what of them makes up the state, limits, metric bases.

Environments and readers of recorded data share these facts, so they live in neither. The tasks themselves are in
:mod:`torchrl_koap.tasks`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchrl_koap.lookup import lookup
from torchrl_koap.tasks.features import FEATURES
from torchrl_koap.tasks.relative_positions import Relation, Relations

CONTROL_HZ = 1 / 0.035
# planner and controller see the same window in every task: 2 observed frames, 14 planned ones; 4 actions of each plan
# are executed
HISTORY, HORIZON, REPLAN_INTERVAL = 2, 14, 4
WINDOW = HISTORY + HORIZON


@dataclass(frozen=True)
class Task:
    """Facts of one D3IL task (lengths in m, angles in rad).

    Args:
        name (str): name used on the command line and in files.
        observation (dict): slice of the observation per part, in the order of the columns.
        command (str): the part that repeats the last command. Its differences *are* the actions, so it is never
            shown to planner or controller.
        position (str): the part that pictures draw, ``x, y`` first.
        action_dim (int): number of action columns.
        max_steps (int): control steps after which an episode is truncated.
        control_hz (float): control steps per second.
        num_modes (int): base of the logarithm of the mode entropy.
        actuated (tuple of int): for every action entry the state column that it moves, by the same filter for all;
            empty if there is none.
        robot (tuple of int): state columns of the robot itself: the recovery augmentation shifts them, and the
            controller reads them (see :meth:`controller_columns`).
        state (dict): part of the observation to name of its features (:mod:`torchrl_koap.tasks.features`), in the
            order of the state. Empty: every part but the command and the hidden ones, unchanged.
        hidden (tuple): further parts that planner and controller must not see.
        objects (tuple of str): what a context places: bodies that start elsewhere in every episode.
        drawn (dict): object (as in ``objects``) to the part of the observation with its ``x, y``.
        collides (bool): an episode can end by a collision.
        action_unit (str): ``"m"`` or ``"rad"``.
        entropy (str): over which episodes the entropy of the modes is taken: ``"all"`` successful ones together, or
            per context and then averaged over ``"contexts"`` or ``"solved_contexts"`` (those with a success).
        label_levels (tuple of float): shares of labelled windows of the label levels 1, 2, ...
        recovery_sigma (float): typical shift of the recovery augmentation, in the units of the actuated columns.
        noise (float): standard deviation of the noise on the measured end effector (m).
        data (str): name of the task whose demonstrations are used, if another one.
        demonstrations (int): number of scripted demonstrations to record by default.
        planner_steps (int): planner updates by default.
        channels (tuple of int): widths of the planner's U-Net by default.
        relative (bool): plans are displacements from the present state by default.
        gripper (tuple of int, optional): action entry of the gripper and state column of its width: its number is read
            off the planned widths (:mod:`torchrl_koap.tasks.gripper`), not decoded.
        scene (tuple): parts whose positions and yaws may be moved and turned together for training, empty if the place
            on the table matters.
        alike (tuple): groups of objects that may be exchanged for training.
        relations (tuple): what the planner is told besides the state: ``(part, seen from part, in the frame of part,
            yaw of part)``, the last two optional (:mod:`torchrl_koap.tasks.relative_positions`).
    """

    name: str
    observation: dict[str, slice]
    command: str
    position: str
    action_dim: int
    max_steps: int
    control_hz: float
    num_modes: int
    actuated: tuple[int, ...] = field(default=())
    robot: tuple[int, ...] = field(default=())
    state: dict[str, str] = field(default_factory=dict)
    hidden: tuple[str, ...] = field(default=())
    objects: tuple[str, ...] = field(default=())
    drawn: dict[str, str] = field(default_factory=dict)
    collides: bool = False
    action_unit: str = "m"
    entropy: str = "all"
    label_levels: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.25)
    recovery_sigma: float = 0.004
    noise: float = 0.0
    data: str = ""
    demonstrations: int = 200
    planner_steps: int = 12000
    channels: tuple[int, ...] = (64, 128)
    relative: bool = True
    gripper: tuple[int, int] | None = None
    relations: tuple[tuple[str, ...], ...] = ()
    scene: tuple[str, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()

    @property
    def observation_dim(self) -> int:
        """Number of observation columns."""
        return max(part.stop for part in self.observation.values())

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Columns that the state is made of: all but the command and the hidden parts."""
        return tuple(
            column for name, _ in self._state_parts for column in range(*self.observation[name].indices(10**6))
        )

    @property
    def state_dim(self) -> int:
        """Number of state columns."""
        return self.state_of(torch.zeros(1, self.observation_dim)).shape[-1]

    @property
    def state_slices(self) -> dict[str, slice]:
        """Columns of the state that every part of the observation ends up in."""
        slices, start = {}, 0
        for name, kind in self._state_parts:
            part = self.observation[name]
            width = FEATURES[kind](torch.zeros(1, part.stop - part.start)).shape[-1]
            slices[name] = slice(start, start + width)
            start += width
        return slices

    @property
    def _state_parts(self) -> list[tuple[str, str]]:
        if self.state:
            return [(name, kind) for name, kind in self.state.items() if name not in self.hidden]
        dropped = {self.command, *self.hidden}
        return [(name, "plain") for name in self.observation if name not in dropped]

    @property
    def plans_position(self) -> bool:
        """Whether the state begins with the position that pictures draw."""
        return self._state_parts[0] == (self.position, "plain")

    @property
    def same_unit(self) -> int:
        """Number of leading action columns that are in ``action_unit``; Stacking's last one is a width in m."""
        return self.action_dim - (self.action_unit == "rad")

    def controller_columns(self, part: str) -> tuple[int, ...]:
        """State columns that a controller reads.

        Args:
            part (str): ``"robot"``: the robot's own, whose motion the actions command; ``"all"``: the whole state, as
                KOAP's configurations have it (spec section 7).

        Raises:
            ValueError: for another part.
        """
        everything = tuple(range(self.state_dim))
        return lookup({"robot": self.robot or everything, "all": everything}, part, "part of the state")

    @property
    def tool_columns(self) -> tuple[int, ...] | None:
        """State columns of a tool position that follows the arm's joints, None where the tool itself is commanded."""
        if self.action_unit != "rad":
            return None
        part = self.state_slices[self.position]
        return tuple(range(part.start, part.stop))

    @property
    def source(self) -> str:
        """Name of the task whose demonstrations are used."""
        return self.data or self.name

    def alike_columns(self) -> list[list[list[int]]]:
        """State columns of the objects that may be exchanged, by group and object."""
        columns = self.state_slices
        return [
            [
                [
                    column
                    for part, place in columns.items()
                    if part.startswith(f"{name}_")
                    for column in range(place.start, place.stop)
                ]
                for name in group
            ]
            for group in self.alike
            if len(group) > 1
        ]

    def scene_columns(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """State columns of the positions ``(x, y)`` and yaws ``(cos, sin)`` that move together."""
        columns = self.state_slices
        pairs = {name: (columns[name].start, columns[name].start + 1) for name in self.scene}
        yaws = [name for name in self.scene if name.endswith(("_quaternion", "_yaw"))]
        return [pair for name, pair in pairs.items() if name not in yaws], [pairs[name] for name in yaws]

    def planner_features(self) -> Relations | None:
        """The task's relations as a module, None if it has none."""
        if not self.relations:
            return None
        columns = self.state_slices
        return Relations([Relation(*(columns[name] for name in names)) for names in self.relations])

    def state_of(self, observation: Tensor) -> Tensor:
        """The state that planner and controller see.

        Args:
            observation (Tensor): ``[*B, obs]``.

        Returns:
            Tensor: ``[*B, d]``.

        Raises:
            ValueError: if the last axis has another size than the task's observation.

        Examples:
            >>> import torch
            >>> from torchrl_koap.tasks import get_task
            >>> get_task("avoiding").state_of(torch.tensor([[1.0, 2.0, 3.0, 4.0]]))
            tensor([[3., 4.]])
        """
        if observation.shape[-1] != self.observation_dim:
            raise ValueError(
                f"an observation of task {self.name!r} has {self.observation_dim} columns, got {observation.shape[-1]}"
            )
        return torch.cat(
            [FEATURES[kind](observation[..., self.observation[name]]) for name, kind in self._state_parts], -1
        )
