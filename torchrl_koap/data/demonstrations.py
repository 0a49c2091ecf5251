# This source code is licensed under the MIT license found in the LICENSE file.
"""Makes a data set with its task from a user's arrays, for ``koap train --dataset``."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from tensordict import TensorDict

from torchrl_koap.data.formats.kinds import kind_of
from torchrl_koap.data.formats.recordings import Recordings, make_recordings, resolves_coarsely, wrong_rate
from torchrl_koap.data.formats.resampling import resampled
from torchrl_koap.data.planner_choices import observed_frames, planner_updates
from torchrl_koap.data.quality import find_warnings
from torchrl_koap.data.roles import COMMAND, Roles, check_kinds, find_roles
from torchrl_koap.data.ted import save_ted
from torchrl_koap.data.trajectories import flatten_trajectories, select_state
from torchrl_koap.files import option, refuse
from torchrl_koap.tasks import Defaults, Task

_SMALLEST, _LARGEST = 1e-18, 1e18  # range that a column may span: float32 can hold the squares
_SLACK = 1.5  # episodes may last this many times the longest demonstration


def save_demonstrations(
    folder: str | Path, states: Sequence[ArrayLike] | Recordings, actions: Any = None, **description: Any
) -> Path:
    """Writes demonstrations, of which few or none have actions, as a data set for ``koap train --dataset``.

    Args:
        folder (str or Path): folder to create; a data set there is replaced once the new one is complete.
        states (sequence of array, or Recordings): frames of every trajectory ``[T_i, d]``, in the units that the robot
            reports; or the result of :func:`~torchrl_koap.data.read_recordings`.
        actions (sequence of array or None, optional): actions ``[T_i, a]`` or ``[T_i - 1, a]`` of every trajectory, NaN
            where there is no label; None for a trajectory without labels. Default: no labels.
        **description: the other arguments of :func:`make_demonstrations`.

    Returns:
        Path: the folder.

    Raises:
        DataError: listing all faults of the arrays and of their description.
        FileExistsError: if ``ted`` in the folder is something other than a data set. Other files there are kept.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data import save_demonstrations
        >>> from torchrl_koap.data.ted import read_about
        >>> states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(5)]
        >>> actions = [np.diff(states[0], axis=0), None, None, None, None]
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_demonstrations(Path(root) / "arm", states, actions, control_hz=30)
        ...     about = read_about(folder / "ted")
        ...     print(about["task"], about["labelled_steps"], about["steps"])
        arm 39 195
    """
    folder = Path(folder).expanduser()
    name = description.pop("name", None) or re.sub(r"\W+", "_", folder.resolve().name).strip("_") or "robot"
    notes: dict[str, Any] = {}
    if isinstance(states, Recordings):
        rates = description.pop("control_hz", None), description.pop("resample", None)
        states = _at_rate(states, *rates, description.get("action_kind", "delta"))
        cameras = {name: [asdict(clip) for clip in clips] for name, clips in states.cameras.items()}
        notes = {"sources": states.sources, "cameras": cameras}
    data, task = make_demonstrations(states, actions, name=name, **description)
    return save_ted(data, folder / "ted", task, notes).parent


def make_demonstrations(
    states: Sequence[ArrayLike] | Recordings,
    actions: Sequence[ArrayLike | None] | None = None,
    *,
    control_hz: float | None = None,
    name: str = "robot",
    state_names: Sequence[str] | None = None,
    state_units: Sequence[str] | str = "",
    action_names: Sequence[str] | None = None,
    action_units: Sequence[str] | str = "",
    action_dim: int | None = None,
    robot: Sequence[str | int] | None = None,
    command: Sequence[str | int] = (),
    action_kind: str | Sequence[str] = "delta",
    targets: Sequence[str | int] | None = None,
    resample: float | None = None,
    max_steps: int | None = None,
) -> tuple[TensorDict, Task]:
    """Makes demonstrations in memory: flat data and their task.

    Args:
        states (sequence of array, or Recordings): as for :func:`save_demonstrations`.
        actions (sequence of array or None, optional): likewise.

    Keyword Args:
        control_hz (float): frames per second. Required unless the recordings have it.
        name (str): name of the task.
        state_names, action_names, action_dim: as for :func:`~torchrl_koap.data.make_recordings`.
        state_units, action_units (sequence of str, or str): unit of every column, or one for all. Errors of actions are
            averaged over columns of one unit.
        robot (sequence of str or int, optional): state columns of the robot, by name or number; the controller reads
            these. Default: all columns that are not commands and change within a recording.
        command (sequence of str or int): neighbouring columns that repeat the last command. Their differences are the
            actions, so they are hidden from all models.
        action_kind (str, or sequence of str): one for all actions, or one for each. ``"delta"``: velocities or changes,
            small when the robot stands still. ``"absolute"``: targets for the columns ``targets``. ``"raw"``: actions
            that neither move a state column nor lie near one, such as torques or normalised targets. For ``resample``,
            give ``"change"`` (over one frame) or ``"velocity"`` instead of ``"delta"``.
        targets (sequence of str or int, optional): the state column of every absolute action. Default: the robot's
            columns, if there are as many.
        resample (float, optional): wanted frames per second, where ``control_hz`` is that of the arrays; see
            :func:`~torchrl_koap.data.read_recordings`.
        max_steps (int, optional): steps after which an episode counts as failed. Default: 1.5 times the longest
            demonstration.

    Returns:
        tuple: flat data ``[N]`` in the storage layout of :mod:`torchrl_koap.keys`, and the
        :class:`~torchrl_koap.tasks.Task`. If float32 resolves a column's movement too coarsely, the middle of its range
        is subtracted and stored as ``task.observation_origin``; an agent subtracts it too.

    Raises:
        DataError: listing all faults: those of :func:`~torchrl_koap.data.make_recordings`; missing or overlapping
            columns; wrong numbers of targets or units; a robot that never moves; a column that no float can hold; a
            command, or an action without a target, whose movement float32 cannot resolve.
        ValueError: if a kind of action is unknown, or recordings come with ``actions``, names or ``action_dim``.

    Warns:
        UserWarning: about unlikely data, as ``koap validate`` does, and trajectories and labels that are left out.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_demonstrations
        >>> data, task = make_demonstrations([np.zeros((20, 3))], control_hz=30, action_dim=2, robot=[0, 1])
        >>> task.observation_dim, task.action_dim, task.robot, bool(data["has_action"].any())
        (3, 2, (0, 1), False)
    """
    check_kinds(action_kind)
    if isinstance(states, Recordings):
        held = {"actions": actions, "state_names": state_names, "action_names": action_names, "action_dim": action_dim}
        if given := [argument for argument, value in held.items() if value is not None]:
            raise ValueError(f"recordings already hold their actions and names; {', '.join(given)} must be None")
        recordings, problems = states, []
    else:
        recordings = make_recordings(
            states,
            actions,
            action_dim=action_dim,
            state_names=state_names,
            action_names=action_names,
            control_hz=control_hz,
        )
        _warn_of(recordings.skipped)
        problems = [
            f"state column {column!r} is a clock, a counter or a flag by its name: leave it out, or rename it"
            for column in recordings.state_names
            if kind_of(column)[0]
        ]
    named = recordings is states or resample is not None
    recordings = _at_rate(recordings, control_hz, resample, action_kind)
    rate = recordings.control_hz
    if rate is None:
        problems.append(f"{option('control_hz')} is missing: frames per second")
    else:
        problems += wrong_rate(rate, "control_hz")
    if max_steps is not None and (isinstance(max_steps, (bool, str)) or not max_steps >= 1 or max_steps % 1):
        problems.append(f"{option('max_steps')} must be a positive whole number, got {max_steps!r}")
    roles = find_roles(
        recordings,
        problems,
        robot=robot,
        command=command,
        action_kind=action_kind,
        targets=targets,
        state_units=state_units,
        action_units=action_units,
    )
    origin, shifted = _without_origin(recordings, roles, problems)
    refuse(f"task {name!r}", problems)
    data, parts = flatten_trajectories([frames - origin for frames in recordings.states], shifted), roles.parts()
    task = Task(
        name=name,
        observation_parts=parts,
        observation_units=roles.state_units,
        observation_origin=tuple(origin.tolist()) if origin.any() else (),
        actions=roles.actions(),
        position=next(part for part in parts if part != COMMAND),
        max_steps=round(_SLACK * max(map(len, recordings.states))) if max_steps is None else int(max_steps),
        control_hz=float(rate),
        command=COMMAND if roles.command else None,
        robot=tuple(map(roles.state_columns.__getitem__, roles.robot)),
    )
    known = select_state(data, task.state_of)
    for said in find_warnings(known, task, recordings.sources if named else ()):
        warnings.warn(said, stacklevel=2)
    planner = {"frames": observed_frames(known, task)[0], "steps": planner_updates(len(known))[0]}
    return data, replace(task, defaults=Defaults(planner=planner))


def _without_origin(recordings: Recordings, roles: Roles, problems: list[str]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns what to subtract from states ``[d]``, and actions without the origins of their targets; adds problems."""
    origin = _origin(np.concatenate(recordings.states), roles.state_names, "state", problems)
    problems += [
        f"command column {roles.state_names[column]!r} is at {origin[column]:.3g}: subtract this value, here and on the"
        " robot"
        for column in roles.command
        if origin[column]
    ]
    added = np.zeros(len(roles.action_names))
    added[list(roles.targets)] = origin[list(roles.targets.values())]
    actions = [steps - added for steps in recordings.actions]
    problems += [
        f"action column {roles.action_names[column]!r} is at {at:.3g}: subtract this value, here and on the robot"
        for column, at in enumerate(_origin(np.concatenate(actions), roles.action_names, "action", problems))
        if at
    ]
    return origin, actions


def _at_rate(
    recordings: Recordings, control_hz: float | None, resample: float | None, action_kind: str | Sequence[str]
) -> Recordings:
    """Sets the rate of recordings if one is given, then resamples them if another one is wanted."""
    recordings = recordings if control_hz is None else replace(recordings, control_hz=control_hz)
    if resample is None:
        return recordings
    found = resampled(recordings, resample, action_kind)
    _warn_of(found.skipped[len(recordings.skipped) :])
    return found


def _warn_of(left_out: Sequence[str]) -> None:
    for said in left_out:
        warnings.warn(f"left out: {said}", stacklevel=3)


def _origin(rows: np.ndarray, names: Sequence[str], kind: str, problems: list[str]) -> np.ndarray:
    """Returns the middle of every column of ``[N, d]`` that float32 resolves too coarsely, 0 for the others."""
    known = rows[np.isfinite(rows).all(-1)]
    if not len(known):
        return np.zeros(rows.shape[1])
    low, high = known.min(0), known.max(0)
    top, span = np.maximum(np.abs(low), np.abs(high)), np.minimum(high, _LARGEST) - np.maximum(low, -_LARGEST)
    lost = (top > _LARGEST) | ((high > low) & (span < _SMALLEST)) | resolves_coarsely(low, high, np.float64)
    problems += [
        f"{kind} column {names[column]!r} lies in {low[column]:.3g} to {high[column]:.3g}, which"
        f" {'float64' if top[column] > 1 else 'float32'} resolves too coarsely: change its unit, or subtract an offset"
        for column in np.flatnonzero(lost)
    ]
    return np.where(resolves_coarsely(low, high, np.float32) & ~lost, low + span / 2, 0.0)
