# This source code is licensed under the MIT license found in the LICENSE file.
"""Roles of the columns of a user's recordings: robot, command, targets of actions, kinds and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from torchrl_koap.data.formats.recordings import Recordings, one_each
from torchrl_koap.data.formats.resampling import ADDS_UP
from torchrl_koap.files import option
from torchrl_koap.lookup import lookup, unknown
from torchrl_koap.tasks import Action
from torchrl_koap.tasks.action_rules import ActionKind

# the kind of an action as a user names it -> as stored, once resampling is done
ACTION_KINDS: dict[str, ActionKind] = {**dict.fromkeys(ADDS_UP, "delta"), "absolute": "absolute", "raw": "raw"}
COMMAND = "command"  # part of the observation


@dataclass(frozen=True)
class Roles:
    """Roles of the columns of recordings, which are given by number."""

    state_names: Sequence[str]
    action_names: Sequence[str]
    robot: Sequence[int]
    command: Sequence[int]
    kinds: Sequence[ActionKind]  # of the actions
    targets: Mapping[int, int]  # state column that each absolute action is a target for
    state_units: tuple[str, ...]
    action_units: tuple[str, ...]

    @property
    def state_columns(self) -> dict[int, int]:
        """Number in the state of every column that models see: all but commands."""
        seen = (column for column in range(len(self.state_names)) if column not in self.command)
        return {column: number for number, column in enumerate(seen)}

    def parts(self) -> dict[str, tuple[str, ...]]:
        """Groups the names of neighbouring columns with the same role."""

        def role(column: int) -> str:
            return COMMAND if column in self.command else "robot" if column in self.robot else "surroundings"

        parts: dict[str, tuple[str, ...]] = {}
        for kind, columns in groupby(range(len(self.state_names)), role):
            number = sum(part.partition("_")[0] == kind for part in parts)
            parts[f"{kind}_{number + 1}" if number else kind] = tuple(self.state_names[column] for column in columns)
        return parts

    def actions(self) -> dict[str, Action]:
        """Returns the meaning of every action."""
        columns = self.state_columns
        described = zip(self.action_names, self.action_units, self.kinds, strict=True)
        return {
            name: Action(unit, kind, columns[self.targets[index]] if index in self.targets else None)
            for index, (name, unit, kind) in enumerate(described)
        }


def check_kinds(action_kind: str | Sequence[str]) -> None:
    """Raises a ValueError for an unknown kind of action, naming the nearest."""
    for kind in (action_kind,) if isinstance(action_kind, str) else action_kind:
        lookup(ACTION_KINDS, kind, "kind of action")


def find_roles(
    recordings: Recordings,
    problems: list[str],
    *,
    robot: Any,
    command: Any,
    action_kind: str | Sequence[str],
    targets: Any,
    state_units: Sequence[str] | str,
    action_units: Sequence[str] | str,
) -> Roles:
    """Finds the roles of columns, given by name or number; adds problems.

    Keyword arguments are those of :func:`~torchrl_koap.data.make_demonstrations`.
    """
    names, acting, moving = recordings.state_names, recordings.action_names, recordings.moving
    commanded = _columns(command, names, "command", problems)
    others = [column for column in range(len(names)) if column not in commanded]
    if robot is None:
        own = [column for column in others if moving[column]] or others
    else:
        own = _columns(robot, names, "robot", problems)
    problems += [f"column {names[column]!r} is both robot and command" for column in own if column in commanded]
    if commanded and commanded != list(range(min(commanded), min(commanded) + len(commanded))):
        problems.append(f"command columns must be adjacent, got {', '.join(names[c] for c in commanded)}")
    if not others:
        problems.append("every column is a command: no state column is left")
    kinds = [ACTION_KINDS[kind] for kind in one_each(action_kind, len(acting), "action_kind", problems)]
    reached = _targets(kinds, targets, own, names, problems)
    if targets is not None:
        problems += [f"column {names[index]!r} is both target and command" for index in reached if index in commanded]
    absolute = [index for index, kind in enumerate(kinds) if kind == "absolute"]
    units = one_each(state_units, len(names), "state_units", problems)
    own_units = one_each(action_units, len(acting), "action_units", problems)
    if not own and robot is not None and not problems:
        problems.append(f"{option('robot')} names no column")
    problems += _robot_at_rest(recordings, own)
    return Roles(names, acting, own, commanded, kinds, dict(zip(absolute, reached, strict=False)), units, own_units)


def _robot_at_rest(recordings: Recordings, own: Sequence[int]) -> list[str]:
    """Returns a list with a message if no column of the robot moves in a recording with labels, else an empty list."""
    both = zip(recordings.states, recordings.actions, strict=True)
    labelled = [frames[:, own] for frames, steps in both if np.isfinite(steps).all(-1).any()]
    if not own or not labelled or any(np.ptp(frames, axis=0).any() for frames in labelled):
        return []
    which = ", ".join(recordings.state_names[column] for column in own)
    return [
        f"robot: {which} never move in labelled trajectories, so the effect of actions is unknown: name others in"
        f" {option('robot')}"
    ]


def _columns(given: Any, names: Sequence[str], what: str, problems: list[str]) -> list[int]:
    """Returns the numbers of columns given by name or number, one or several."""
    given = [given] if isinstance(given, (str, int, slice)) else list(given)
    odd = [column for column in given if isinstance(column, bool) or not isinstance(column, (str, int, np.integer))]
    if odd:
        problems.append(f"{option(what)} takes columns by name or number, got {odd[0]!r}")
        return []
    problems += unknown([column for column in given if isinstance(column, str)], names, f"column in {option(what)}:")
    numbers = [names.index(column) if column in names else column for column in given]
    found = [int(number) for number in numbers if not isinstance(number, str) and 0 <= number < len(names)]
    problems += [
        f"{option(what)}: there is no column {number}, only 0..{len(names) - 1}"
        for number in numbers
        if not isinstance(number, str) and number not in found
    ]
    repeated = sorted({names[column] for column in found if found.count(column) > 1})
    if repeated:
        problems.append(f"{option(what)} holds {', '.join(repeated)} more than once")
    return found


def _targets(
    kinds: Sequence[str],
    given: Sequence[str | int] | None,
    own: Sequence[int],
    names: Sequence[str],
    problems: list[str],
) -> list[int]:
    """Returns the target columns of absolute actions."""
    number = kinds.count("absolute")
    if not number:
        if given is not None:
            problems.append(f"{option('targets')} requires {option('action_kind')} 'absolute'")
        return []
    columns = list(own) if given is None else _columns(given, names, "targets", problems)
    if len(columns) != number:
        what = "columns of the robot" if given is None else "targets"
        problems.append(
            f"absolute actions: {number}, {what}: {len(columns)}; name in {option('targets')} the column that each"
            f" action is a target for (known: {', '.join(names)}); an action without such a column is 'raw'"
        )
    return columns
