# This source code is licensed under the MIT license found in the LICENSE file.
"""Observation columns and what of them makes up the state that planner and controller see."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from torchrl_koap.tasks.import_strings import resolve

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

# names that a feature gives to its columns; those of a plain part, and of a feature of one's own, are numbered
FEATURE_COLUMNS = {"plane": ("x", "y"), "tan_yaw": ("cos_2yaw", "sin_2yaw"), "quaternion": ("cos_yaw", "sin_yaw")}


class StateParts:
    """Base of :class:`~torchrl_koap.tasks.Task`: which columns observation and state have, by part and by name.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> avoiding = get_task("avoiding")
        >>> avoiding.observation_dim, avoiding.command_columns, avoiding.state_dim
        (4, slice(0, 2, None), 2)
    """

    if TYPE_CHECKING:  # fields of a task
        name: str
        observation_parts: Mapping[str, int | tuple[str, ...]]
        position: str
        command: str | None
        state: dict[str, str]
        hidden: tuple[str, ...]
        tool_kinematics: str | None
        planar_parts: tuple[str, ...]
        interchangeable: tuple[tuple[str, ...], ...]

    @cached_property
    def observation(self) -> dict[str, slice]:
        """Slice of the observation per part, in the order of the columns."""
        slices, start = {}, 0
        for name, columns in self.observation_parts.items():
            width = columns if isinstance(columns, int) else len(columns)
            slices[name] = slice(start, start + width)
            start += width
        return slices

    @property
    def command_columns(self) -> slice | None:
        """Observation columns that repeat the last command, None where none do."""
        return None if self.command is None else self.observation[self.command]

    @property
    def observation_dim(self) -> int:
        """Number of observation columns."""
        return max(part.stop for part in self.observation.values())

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation columns: those given, else the part's with a number."""
        return tuple(name for part in self.observation_parts for name in self._column_names(part))

    @cached_property
    def state_parts(self) -> dict[str, str]:
        """Parts that make up the state, in its order, with the name of their feature."""
        if self.state:
            return {name: kind for name, kind in self.state.items() if name not in self.hidden}
        dropped = {self.command, *self.hidden}
        return {name: "plain" for name in self.observation_parts if name not in dropped}

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Observation columns that the state is made of: all but the command and the hidden parts."""
        parts = (self.observation[name] for name in self.state_parts)
        return tuple(column for part in parts for column in range(part.start, part.stop))

    @cached_property
    def state_slices(self) -> dict[str, slice]:
        """Columns of the state that every part of the observation ends up in."""
        slices, start = {}, 0
        for name, kind in self.state_parts.items():
            width = len(self._feature_names(name, kind))
            slices[name] = slice(start, start + width)
            start += width
        return slices

    @property
    def state_dim(self) -> int:
        """Number of state columns."""
        return max(part.stop for part in self.state_slices.values())

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state columns."""
        return tuple(name for part, kind in self.state_parts.items() for name in self._feature_names(part, kind))

    @property
    def state_units(self) -> tuple[str, ...]:
        """Unit of every state column: that of its observation column where the part is unchanged, else ``""``."""
        given = getattr(self, "observation_units", ()) or ("",) * self.observation_dim
        units: list[str] = []
        for part, kind in self.state_parts.items():
            names = self._feature_names(part, kind)
            units += given[self.observation[part]] if kind == "plain" else [""] * len(names)
        return tuple(units)

    @property
    def plans_position(self) -> bool:
        """Whether the state begins with the position that pictures draw."""
        return next(iter(self.state_parts.items())) == (self.position, "plain")

    @property
    def tool_columns(self) -> tuple[int, ...] | None:
        """State columns of a tool position that follows the joints, None where the tool itself is commanded."""
        if self.tool_kinematics is None:
            return None
        part = self.state_slices[self.position]
        return tuple(range(part.start, part.stop))

    def interchangeable_columns(self) -> list[list[list[int]]]:
        """State columns of the bodies that may be permuted, by group and body."""
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
            for group in self.interchangeable
            if len(group) > 1
        ]

    def planar_columns(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """State columns of the positions ``(x, y)`` and yaws ``(cos, sin)`` that move together."""
        columns = self.state_slices
        pairs = {name: (columns[name].start, columns[name].start + 1) for name in self.planar_parts}
        yaws = [name for name in self.planar_parts if self.state_parts[name] == "quaternion"]
        return [pair for name, pair in pairs.items() if name not in yaws], [pairs[name] for name in yaws]

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
        import torch

        if observation.shape[-1] != self.observation_dim:
            raise ValueError(
                f"an observation of task {self.name!r} has {self.observation_dim} columns, got {observation.shape[-1]}"
            )
        parts = self.state_parts.items()
        return torch.cat([self._feature(kind)(observation[..., self.observation[name]]) for name, kind in parts], -1)

    def _column_names(self, part: str) -> tuple[str, ...]:
        columns = self.observation_parts[part]
        if not isinstance(columns, int):
            return tuple(columns)
        return (part,) if columns == 1 else tuple(f"{part}_{index}" for index in range(columns))

    def _feature(self, kind: str) -> Any:
        from torchrl_koap.tasks.features import FEATURES

        return FEATURES[kind] if kind in FEATURES else resolve(kind, f"a feature of task {self.name!r}")

    def _feature_names(self, part: str, kind: str) -> tuple[str, ...]:
        if kind == "plain":
            return self._column_names(part)
        if kind in FEATURE_COLUMNS:
            return tuple(f"{part}_{name}" for name in FEATURE_COLUMNS[kind])
        import torch

        columns = self.observation[part]
        width = self._feature(kind)(torch.zeros(1, columns.stop - columns.start)).shape[-1]
        return tuple(f"{part}_{index}" for index in range(width))
