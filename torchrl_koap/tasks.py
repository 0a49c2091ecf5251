# This source code is licensed under the MIT license found in the LICENSE file.
"""What a task *is* for learning code: names of the observation columns, the controller's mask, limits, metric base.

Environments and readers of recorded data share these facts, so they live in neither.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torchrl_koap.lookup import lookup


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
        actuated (tuple of int): for every action entry the state column that it moves; empty if there is none.
        hidden (tuple): further parts that planner and controller must not see.
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
    hidden: tuple[str, ...] = field(default=())

    @property
    def observation_dim(self) -> int:
        """Number of observation columns."""
        return max(part.stop for part in self.observation.values())

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Columns that planner and controller see: all but the command and the hidden parts."""
        dropped = {self.command, *self.hidden}
        return tuple(
            column
            for name, part in self.observation.items()
            if name not in dropped
            for column in range(part.start, part.stop)
        )


TASKS = {
    "avoiding": Task(
        name="avoiding",
        observation={"desired_xy": slice(0, 2), "measured_xy": slice(2, 4)},
        command="desired_xy",
        position="measured_xy",
        action_dim=2,
        max_steps=250,
        control_hz=1 / 0.035,
        num_modes=24,
        actuated=(0, 1),
    ),
}


def get_task(name: str) -> Task:
    """Looks a task up by name.

    Raises:
        ValueError: if the name is unknown; the message suggests the nearest one.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> get_task("avoiding").state_columns
        (2, 3)
    """
    return lookup(TASKS, name, "task")
