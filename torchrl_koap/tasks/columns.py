# This source code is licensed under the MIT license found in the LICENSE file.
"""Columns of observation and state: their names and units, and angles without poles.

D3IL provides ``tan(yaw)``, which has poles, and full quaternions, of which a box on a table uses one angle. Both become
a point on the unit circle; ``tan(yaw)`` determines the yaw only up to half a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor


def double_yaw(tan_yaw: Tensor) -> Tensor:
    """Computes ``cos 2 yaw, sin 2 yaw`` from ``tan(yaw)`` ``[*B, 1]``: continuous where the tangent has its poles."""
    double = 2 * tan_yaw.atan()
    return torch.cat([double.cos(), double.sin()], -1)


def yaw_of(quaternion: Tensor) -> Tensor:
    """Computes ``cos yaw, sin yaw`` from quaternions ``[*B, 4]`` (w, x, y, z), whose sign does not matter."""
    w, x, y, z = quaternion.unbind(-1)
    direction = torch.stack([1 - 2 * (y * y + z * z), 2 * (w * z + x * y)], -1)
    return direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def tan_yaw(quaternion: np.ndarray) -> np.ndarray:
    """Computes ``tan(yaw)`` ``[...]`` of quaternions ``[..., 4]`` (w, x, y, z), with D3IL's sign of ``x y``."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.tan(np.arctan2(2 * (w * z - x * y), 1 - 2 * (y**2 + z**2)))


# features of parts in the state: function and column names; columns of a plain part keep their names
FEATURES: dict[str, tuple[Callable[[Tensor], Tensor], tuple[str, ...]]] = {
    "plain": (lambda columns: columns, ()),
    "plane": (lambda position: position[..., :2], ("x", "y")),  # for bodies on a surface, whose height is constant
    "tan_yaw": (double_yaw, ("cos_2yaw", "sin_2yaw")),
    "quaternion": (yaw_of, ("cos_yaw", "sin_yaw")),
}
_WITH_UNITS = ("plain", "plane")  # features that keep the units of their columns
_THOUSANDTHS = {"m": "mm", "rad": "mrad", "s": "ms", "N": "mN"}  # units in which small values are shown


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Names and order of the columns of observation and state.

    Args:
        name (str): owner of the columns, such as the task.
        observation_parts (dict): parts of the observation in the order of the columns: a number of columns, or their
            names. A number gives columns the name of the part, numbered if there are several.
        observation_units (tuple of str): unit of every observation column; empty: see :attr:`known_units`.
        observation_origin (tuple of float): offset subtracted from every column of the data, so that float32 resolves
            them; robots report and take values with it (:class:`~torchrl_koap.modules.Agent`). Empty: none.
        command (str, optional): the part that repeats the last command. Its differences *are* the actions, so it is
            never shown to planner or controller. None: the observation holds no command.
        state (dict): parts of the observation with their feature (``FEATURES``), in the order of the state. Empty:
            all parts except the command and the hidden ones, unchanged.
        hidden (tuple of str): further parts that planner and controller must not see.

    Examples:
        >>> from torchrl_koap.tasks import Columns
        >>> arm = Columns(name="arm", observation_parts={"sent": 2, "q": 2, "cup": ("x", "y")}, command="sent")
        >>> arm.observation_dim, arm.command_columns, arm.state_names
        (6, slice(0, 2, None), ('q_0', 'q_1', 'x', 'y'))
    """

    name: str
    observation_parts: Mapping[str, int | tuple[str, ...]]
    observation_units: tuple[str, ...] = ()
    observation_origin: tuple[float, ...] = ()
    command: str | None = None
    state: Mapping[str, str] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()

    @cached_property
    def observation(self) -> dict[str, slice]:
        """Observation columns of every part."""
        return _slices(
            {part: given if isinstance(given, int) else len(given) for part, given in self.observation_parts.items()}
        )

    @property
    def command_columns(self) -> slice | None:
        """Observation columns that repeat the last command; None if there are none."""
        return None if self.command is None else self.observation[self.command]

    @property
    def observation_dim(self) -> int:
        """Number of observation columns."""
        return max(part.stop for part in self.observation.values())

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation columns: as given, else the part's name with a number."""
        return tuple(name for part in self.observation_parts for name in self._column_names(part))

    @cached_property
    def state_parts(self) -> dict[str, str]:
        """Parts of the state in its order, with the name of their feature."""
        if self.state:
            return {name: kind for name, kind in self.state.items() if name not in self.hidden}
        dropped = {self.command, *self.hidden}
        return {name: "plain" for name in self.observation_parts if name not in dropped}

    @property
    def state_columns(self) -> tuple[int, ...]:
        """Observation columns that the state is made of."""
        parts = (self.observation[name] for name in self.state_parts)
        return tuple(column for part in parts for column in range(part.start, part.stop))

    @cached_property
    def state_slices(self) -> dict[str, slice]:
        """State columns of every part of the state."""
        return _slices({part: len(self._feature_names(part, kind)) for part, kind in self.state_parts.items()})

    @property
    def state_dim(self) -> int:
        """Number of state columns."""
        return max(part.stop for part in self.state_slices.values())

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state columns."""
        return tuple(name for part, kind in self.state_parts.items() for name in self._feature_names(part, kind))

    @property
    def known_units(self) -> tuple[str, ...]:
        """Unit of every observation column. Without ``observation_units``: m for positions, rad for joints, by name."""
        called = {"_xy": "m", "_xyz": "m", "_position": "m", "joints": "rad"}
        unit = {part: next((u for end, u in called.items() if part.endswith(end)), "") for part in self.observation}
        return self.observation_units or tuple(unit[part] for part in unit for _ in self._column_names(part))

    @property
    def state_units(self) -> tuple[str, ...]:
        """Unit of every state column, by :attr:`known_units`; ``""`` for features of angles."""
        units: list[str] = []
        for part, kind in self.state_parts.items():
            width = len(self._feature_names(part, kind))
            units += self.known_units[self.observation[part]][:width] if kind in _WITH_UNITS else ("",) * width
        return tuple(units)

    def state_of(self, observation: Tensor) -> Tensor:
        """Selects the state ``[*B, d]`` that planner and controller see from observations ``[*B, obs]``.

        Raises:
            ValueError: if the last axis differs in size from the task's observation.
        """
        if observation.shape[-1] != self.observation_dim:
            raise ValueError(
                f"an observation of task {self.name!r} has {self.observation_dim} columns, got {observation.shape[-1]}"
            )
        parts = self.state_parts.items()
        return torch.cat([FEATURES[kind][0](observation[..., self.observation[name]]) for name, kind in parts], -1)

    def _column_names(self, part: str) -> tuple[str, ...]:
        columns = self.observation_parts[part]
        if not isinstance(columns, int):
            return tuple(columns)
        return (part,) if columns == 1 else tuple(f"{part}_{index}" for index in range(columns))

    def _feature_names(self, part: str, kind: str) -> tuple[str, ...]:
        return self._column_names(part) if kind == "plain" else tuple(f"{part}_{name}" for name in FEATURES[kind][1])


def _slices(widths: Mapping[str, int]) -> dict[str, slice]:
    """Returns the slices of adjacent parts by their widths."""
    slices, start = {}, 0
    for part, width in widths.items():
        slices[part] = slice(start, start + width)
        start += width
    return slices


def thousandths(unit: str) -> tuple[str, float]:
    """Returns the unit for showing small values and the factor to it, such as ``("mm", 1e3)`` for metres."""
    return (_THOUSANDTHS[unit], 1e3) if unit in _THOUSANDTHS else (unit, 1.0)


def unit_groups(units: Sequence[str]) -> dict[str, list[int]]:
    """Groups columns by unit, in order of appearance of the units."""
    groups: dict[str, list[int]] = {}
    for column, unit in enumerate(units):
        groups.setdefault(unit, []).append(column)
    return groups
