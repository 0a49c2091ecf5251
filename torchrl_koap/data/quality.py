# This source code is licensed under the MIT license found in the LICENSE file.
"""Warns of valid but unlikely demonstrations; cuts still ends and drops short trajectories."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap import keys
from torchrl_koap.data.action_kinds import command_warnings, kind_warnings
from torchrl_koap.data.formats.clocks import FASTEST, SLOWEST, rises_evenly
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.data.late_labels import late_warnings
from torchrl_koap.data.odd_values import (
    leap_warnings,
    mark_warnings,
    quaternion_warnings,
    scale_warnings,
    spike_warnings,
    turn_warnings,
    unlabelled_warnings,
)
from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.files import DataError, option, some
from torchrl_koap.tasks import HORIZON, WINDOW, Task

FARTHEST = 100.0  # m or rad: no tabletop robot reaches this
STILL, MUCH = 2e-3, 0.2  # still: within this share of the range; warn above this share of still frames
APART = 50.0  # warn if a column moves this many times as far as a fifth of them: joint errors hide those
ROUNDING = 1e-5  # a column that moves less than this share of the farthest one rests
NOISE = 8.0  # still as well: within this many standard deviations of the noise at that end of the recordings
CANCELS = 0.25  # noise: -(product of neighbouring steps) / square step above this; 0.5 for noise, 0 for a random walk
LAGS, UNLIKE = 3, 0.9  # noise alone: frames up to LAGS apart differ by this share of what unrelated ones do
JITTER = 0.5  # share of its mean step by which a clock's steps may differ
SELDOM, FEW = 0.05, 3  # a goal changes in less than this share of the steps, and takes more values than this
AS_FAR = 0.5  # of the mean square distance between any two frames: motions repeat above this
LOOKED_AT = 20_000  # windows to check for repeating motions
SHORT, ENOUGH = 0.02, 0.05  # share of a demonstration that a plan covers: warn below, suggest a rate that reaches this


def find_warnings(data: TensorDictBase, task: Task, names: Sequence[str] = ()) -> list[str]:
    """Returns a sentence for each unlikely property of demonstrations, flat data ``[N]`` with ``state``.

    * Trajectories: repeat another one, never move, are shorter than a window, have only zero labels or another unit,
      reach beyond 100 m or rad, lie far from all labelled ones or move much less than these.
    * State columns: constant, noise alone, equal to another one, leaping, with marks of missing values, clocks,
      quaternions that change sign, angles a turn apart, or without unit and moving much farther than others; still
      frames at both ends.
    * Actions: another kind than declared, late, constant, leaping for one frame, or with marks of missing values.
    * A command that no action follows; goals that the controller reads; isolated labels; an unlikely rate;
      plans that are short against the motion.

    ``names`` labels each trajectory, for example by its file. Default: their numbers.
    """
    lengths = trajectory_lengths(data).tolist()
    called = [*names, *(f"trajectory {index}" for index in range(len(names), len(lengths)))]
    state = data.get(keys.STATE).cpu()
    frames = [part.double().numpy() for part in state.split(lengths)]
    constants = zip(task.action_names, constant_columns(data.get(keys.ACTION).cpu().numpy()), strict=True)
    _, short_plans = plan_coverage(data, task.control_hz)
    known = data.get(keys.HAS_ACTION).squeeze(-1).split(lengths)
    actions = [steps.double().cpu().numpy() for steps in data.get(keys.ACTION).split(lengths)]
    labels = [steps[labelled.cpu().numpy()] for steps, labelled in zip(actions, known, strict=True)]
    return [
        *kind_warnings(data, task, called),
        *command_warnings(data, task),
        *late_warnings(data, task),
        *_trajectory_warnings(data, task, lengths, called),
        *_short(lengths, called),
        *_column_warnings(state, task.state_names),
        *_noise_alone(frames, task.state_names),
        *leap_warnings(frames, called, task.state_names),
        *quaternion_warnings(frames, task.state_names),
        *turn_warnings(frames, task.state_names),
        *mark_warnings(np.concatenate(frames), task.state_names, "column"),
        *scale_warnings(frames, called, task.state_names, "column"),
        *_without_units(frames, task),
        *unlabelled_warnings(
            [part[:, task.robot] for part in frames],  # not the surroundings: a few labelled recordings show few goals
            [bool(part.any()) for part in known],
            called,
            [task.state_names[column] for column in task.robot],
        ),
        *_stillness(frames, called),
        *_clocks(frames, task),
        *_goals(frames, task),
        *spike_warnings(actions, called, task.action_names),
        *mark_warnings(np.concatenate(labels), task.action_names, "action"),
        *scale_warnings(labels, called, task.action_names, "action"),
        *_single_labels(known, called),
        *(
            f"action {name!r} is {value:g} in all labels: controllers command this value, method dp a value near it"
            for name, value in constants
            if value is not None
        ),
        *([] if short_plans is None else [short_plans]),
    ]


def _trajectory_warnings(
    data: TensorDictBase, task: Task, lengths: Sequence[int], called: Sequence[str]
) -> Iterator[str]:
    first: dict[bytes, str] = {}
    names, units = task.observation_names, task.known_units
    checked = [column for column, unit in enumerate(units) if unit in ("m", "rad")]
    read = (keys.OBSERVATION, keys.ACTION, keys.HAS_ACTION, keys.NEXT_OBSERVATION)
    parts = [data.get(key).split(lengths) for key in read]
    for name, observed, steps, has_action, last in zip(called, *parts, strict=True):
        digest = _digest(observed, last[-1:])  # states only: labels may differ
        if digest in first:
            yield f"{name} repeats {first[digest]}: all states are equal; leave out the one with fewer labels"
            continue
        first[digest] = name
        labelled = steps[has_action.squeeze(-1)]
        if len(labelled) and not labelled.any():
            yield f"{name}: all {len(labelled)} labelled actions are zero"
        if bool((observed == observed[:1]).all()) and bool((last == observed[:1]).all()):
            yield f"{name}: nothing moves in its {len(observed)} steps"
        farthest = observed.abs().amax(0)
        far = next((column for column in checked if farthest[column] > FARTHEST), None)
        if far is not None:
            yield f"{name}: {names[far]} reaches {farthest[far]:.3g} {units[far]}"


def _short(lengths: Sequence[int], called: Sequence[str]) -> Iterator[str]:
    short = [f"{name} ({length})" for name, length in zip(called, lengths, strict=True) if length < WINDOW]
    if short:
        yield (
            f"{len(short)} of {len(lengths)} trajectories have fewer steps than a window of {WINDOW}, so training may"
            f" refuse them: {some(short)}; remove them, in Python or with `koap convert --drop-short`"
        )


def _column_warnings(state: Tensor, names: Sequence[str]) -> Iterator[str]:
    first: dict[bytes, str] = {}
    for name, values in zip(names, state.unbind(-1), strict=True):
        if bool((values == values[:1]).all()):
            yield f"column {name!r} is {values[0]:g} in all {len(values)} steps: it carries no information"
        elif (same := first.setdefault(_digest(values), name)) is not name:
            yield f"columns {same!r} and {name!r} are the same in every step"


def _noise_alone(trajectories: Sequence[np.ndarray], names: Sequence[str]) -> Iterator[str]:
    """Finds columns without motion: few frames equal the one before, and frames up to ``LAGS`` apart differ alike."""
    long, spread = [frames for frames in trajectories if len(frames) > LAGS], np.concatenate(trajectories).var(0)
    if not long:
        return
    steps = [np.concatenate([frames[lag:] - frames[:-lag] for frames in long]) for lag in range(1, LAGS + 1)]
    alone = np.all([np.square(step).mean(0) > 2 * UNLIKE * spread for step in steps], axis=0)
    alone &= (np.median(np.abs(steps[0]), axis=0) > 0) & (spread > 0)
    if alone.any():
        said = some([repr(names[column]) for column in np.flatnonzero(alone)])
        yield f"columns {said} show noise alone, no motion: they carry no information; leave them out"


def _without_units(trajectories: Sequence[np.ndarray], task: Task) -> Iterator[str]:
    moved = np.median([np.ptp(frames, axis=0) for frames in trajectories], axis=0)
    unitless = sorted((column for column, unit in enumerate(task.state_units) if not unit), key=moved.__getitem__)
    moving = [column for column in unitless if moved[column] > ROUNDING * moved[unitless[-1]]]
    if not moving:
        return
    most, little = moving[-1], moving[: max(len(moving) // 5, 1)]
    if moved[most] > APART * moved[little[-1]]:
        yield (
            f"columns without a unit: {task.state_names[most]!r} moves {moved[most]:.3g} in a trajectory,"
            f" {some([repr(task.state_names[column]) for column in little])} at most {moved[little[-1]]:.3g}:"
            f" plan errors hardly reflect the latter; if units differ, give {option('state_units')}"
        )


def _clocks(trajectories: Sequence[np.ndarray], task: Task) -> Iterator[str]:
    moving = np.flatnonzero(np.ptp(np.concatenate(trajectories), axis=0))
    even = [column for column in moving if rises_evenly([frames[:, column] for frames in trajectories], room=JITTER)]
    if len(even) < len(moving):  # if all columns rise evenly, this is the motion itself
        for column in even:
            said = "rises by nearly the same amount in every frame: it looks like a clock; leave it out"
            yield f"column {task.state_names[column]!r} {said}"
    if not SLOWEST <= task.control_hz <= FASTEST:
        yield f"control_hz is {task.control_hz:g}: frames per second, not seconds per frame?"


def _goals(trajectories: Sequence[np.ndarray], task: Task) -> Iterator[str]:
    """Finds columns of the robot that seldom change, for one step and to new values: goals, not switches or joints."""
    changes = [frames[1:] != frames[:-1] for frames in trajectories]
    number, steps = np.sum([part.sum(0) for part in changes], axis=0), sum(map(len, changes))
    apart = 10 * np.sum([(part[1:] & part[:-1]).sum(0) for part in changes], axis=0) <= number
    values = np.array([len(np.unique(column)) for column in np.concatenate(trajectories).T])
    goals = apart & (number > 0) & (number < SELDOM * steps) & (values > FEW)
    if found := [repr(task.state_names[column]) for column in task.robot if goals[column]]:
        yield (
            f"the controller reads {some(found)}, which keep one value and then leap to another: if these are goals,"
            f" name the robot's columns in {option('robot')}"
        )


def _single_labels(known: Sequence[Tensor], called: Sequence[str]) -> Iterator[str]:
    """Finds trajectories in which most labels are isolated."""
    few = []
    for name, labelled in zip(called, known, strict=True):
        alone = labelled[1:-1] & ~labelled[:-2] & ~labelled[2:]
        if 2 * int(alone.sum()) > int(labelled.sum()) > 1:
            few.append(f"{name} ({int(labelled.sum())} of {len(labelled)} steps)")
    if few:
        yield (
            f"most labels are isolated in {len(few)} trajectories: {some(few)}; if actions are logged only when they"
            " change, repeat the last one"
        )


def still_ends(trajectories: Sequence[np.ndarray]) -> np.ndarray:
    """Counts the frames at both ends of trajectories ``[T_i, d]`` in which no column moves, int ``[n, 2]``.

    Sensor noise is not movement. The still frames next to the movement are not counted. A trajectory in which nothing
    ever moves, or so slowly that both ends overlap, has none.
    """
    least = STILL * np.ptp(np.concatenate(trajectories), axis=0)
    found = np.zeros((len(trajectories), 2), dtype=int)
    for end, order in enumerate((1, -1)):
        room = np.maximum(least, NOISE * _noise([frames[::order][:WINDOW] for frames in trajectories]))
        for number, frames in enumerate(trajectories):
            moves = (np.abs(frames[::order] - frames[::order][0]) > room).any(-1)
            found[number, end] = max(int(moves.argmax()) - 1, 0)
    lengths = np.array([len(frames) for frames in trajectories])
    return np.where(found.sum(1, keepdims=True) + 2 > lengths[:, None], 0, found)


def _noise(parts: Sequence[np.ndarray]) -> np.ndarray | float:
    """Estimates the standard deviation ``[d]`` of noise from neighbouring steps; 0 for columns that move."""
    steps = [np.diff(part, axis=0) for part in parts if len(part) == WINDOW]
    if not steps:
        return 0.0
    products = np.array([-(step[1:] * step[:-1]).mean(0) for step in steps])
    squares = np.array([np.square(step).mean(0) for step in steps])
    alone = np.median(products / np.maximum(squares, 1e-300), axis=0) > CANCELS
    return np.sqrt(np.median(products, axis=0).clip(0) * alone)


def _stillness(trajectories: Sequence[np.ndarray], called: Sequence[str]) -> Iterator[str]:
    ends, lengths = still_ends(trajectories), np.array([len(frames) for frames in trajectories])
    shares, longest = ends.sum(0) / lengths.sum(), int((ends.sum(1) / lengths).argmax())
    if shares.max() > MUCH:
        yield (
            f"nothing moves in {shares[0]:.0%} of all frames at the start and {shares[1]:.0%} at the end of"
            f" trajectories (most in {called[longest]}: {ends[longest, 0]} and {ends[longest, 1]} of"
            f" {lengths[longest]}), so a policy may learn to stand still: cut them (`koap convert --trim-still`)"
        )


def trim_still(recordings: Recordings) -> Recordings:
    """Cuts the still frames at both ends of trajectories; ``skipped`` counts them."""
    ends = still_ends(recordings.states)
    spans = [
        (number, ends[number, 0], len(frames) - ends[number, 1]) for number, frames in enumerate(recordings.states)
    ]
    return recordings.cut(spans, [f"{ends.sum()} still frames of {ends.any(1).sum()} trajectories"])


def drop_short(recordings: Recordings) -> Recordings:
    """Drops trajectories with fewer steps than a window; ``skipped`` names them."""
    lengths = list(map(len, recordings.states))
    spans = [(number, 0, length) for number, length in enumerate(lengths) if length > WINDOW]
    if not spans:
        raise DataError("these recordings", f"no trajectory has the {WINDOW} steps of a window")
    named = zip(recordings.sources, lengths, strict=True)
    return recordings.cut(spans, [f"{name} ({length - 1} steps)" for name, length in named if length <= WINDOW])


def plan_coverage(data: TensorDictBase, control_hz: float) -> tuple[str, str | None]:
    """Describes how long a plan and the demonstrations of flat data ``[N]`` last at ``control_hz``.

    The second value is a warning if a plan is short against the motion, else None. Motions that repeat within a plan,
    such as a gait, may have any length.
    """
    frames = float(trajectory_lengths(data).double().median())
    covers = f"{HORIZON} frames, {1e3 * HORIZON / control_hz:.4g} ms"
    lasts = f"demonstrations last {frames / control_hz:.4g} s (median)"
    if HORIZON >= SHORT * frames or _repeats(data):
        return f"{covers}; {lasts}", None
    every = math.ceil(ENOUGH * frames / HORIZON)
    return f"{covers}; {lasts}", (
        f"a plan covers {covers}, {HORIZON / frames:.1%} of a demonstration: short against the motion. A rate of"
        f" {control_hz / every:.3g} Hz (one frame in {every}) would let it look farther: {option('resample')}"
    )


def _repeats(data: TensorDictBase) -> bool:
    """Checks whether most columns move as far within a plan as between any two frames, as in a gait."""
    observed, episode = data.get(keys.OBSERVATION), data.get(keys.EPISODE)
    variance = observed.double().var(0)
    now = spread_evenly((episode[:-HORIZON] == episode[HORIZON:]).nonzero().squeeze(-1), LOOKED_AT)
    moved = [observed[now + ahead].double() - observed[now] for ahead in (HORIZON // 2, HORIZON)]
    share = torch.stack([steps.square().mean(0) for steps in moved]).amax(0) / (2 * variance)
    return bool(share[variance > 0].nanmedian() > AS_FAR)


def goal_columns(recordings: Recordings) -> list[str]:
    """Names state columns that are constant in each trajectory and differ between them: goals, or varied conditions."""
    differ = np.ptp([frames[0] for frames in recordings.states], axis=0) > 0
    return [name for name, goal in zip(recordings.state_names, ~recordings.moving & differ, strict=True) if goal]


def constant_columns(actions: np.ndarray) -> list[float | None]:
    """Returns the constant value of each column of actions ``[N, act]``; None if it varies or has at most one label."""
    steps = actions[np.isfinite(actions).all(-1)]
    return [float(column[0]) if len(column) > 1 and np.ptp(column) == 0 else None for column in steps.T]


def _digest(*values: Tensor) -> bytes:
    return hashlib.sha256(b"".join(value.cpu().numpy().tobytes() for value in values)).digest()
