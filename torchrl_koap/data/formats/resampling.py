# This source code is licensed under the MIT license found in the LICENSE file.
"""Resamples recordings: interpolates states, and holds or sums actions between recorded frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_koap.data.formats.clocks import ROUNDED, UNEVEN
from torchrl_koap.data.formats.recordings import Recordings, one_each, wrong_rate
from torchrl_koap.files import DataError, option, refuse, some
from torchrl_koap.lookup import lookup

# kinds of actions: whether they add up over the frames of a longer step; None if the kind does not determine it
ADDS_UP = {"delta": None, "change": True, "velocity": False, "absolute": False, "raw": False}
LEAP, UNUSUAL = 1 / 3, 20.0  # a leap: a step above this share of the range and this many times the median step
MOST = 2.0  # largest number of new frames per recorded step
GAP = 2.5  # steps without a frame after which a trajectory ends: one lost frame leaves two, and clocks jitter
_LEVELS = 10  # a column with at most this many values, all integers, is a switch
_SAME = 1e-3  # rounding error, as a share of a step
_UNIT, _MOSTLY = 0.01, 0.9  # tolerance of a quaternion's norm; share of the frames that must be within it


def resampled(
    recordings: Recordings,
    control_hz: float,
    action_kind: str | Sequence[str] = "delta",
    *,
    times: Sequence[np.ndarray] | None = None,
) -> Recordings:
    """Resamples recordings to a fixed rate, ``control_hz`` frames per second.

    States are interpolated linearly. The nearest frame is used where a column leaps (a wrapped angle, a quaternion that
    changes sign), in columns of at most ten integers (a switch), and for cameras. Changes over one frame are summed
    over the new step; if part of it is unlabelled, it has no label. Other actions take their value at its beginning. A
    gap of more than 2.5 steps, recorded or new, ends a trajectory; ``skipped`` counts these.

    ``action_kind`` is as for :func:`~torchrl_koap.data.make_demonstrations`. ``times`` are the increasing times of
    every frame ``[T_i]`` in seconds. Default: evenly spaced by ``recordings.control_hz``.

    Raises:
        DataError: listing all faults: no rate, more than two new frames in a recorded step, labels of the ambiguous
            kind ``"delta"``, no trajectory of two new frames.
        ValueError: if a kind of action is unknown.
    """
    known = recordings.control_hz
    unfit: list[str] = []
    kinds = one_each(action_kind, len(recordings.action_names), "action_kind", unfit)
    summing = [lookup(ADDS_UP, kind, "kind of action") for kind in kinds]
    problems = wrong_rate(control_hz, "resample")
    if times is None and known is None:
        problems.append(f"the rate of the recordings is not known: pass {option('control_hz')}")
    elif times is None:
        problems += wrong_rate(known, "control_hz")
    refuse("these recordings", problems)
    if times is None:
        times = [np.arange(len(frames)) / known for frames in recordings.states]
    usual = [float(np.median(np.diff(at))) for at in times]
    dense = [
        f"{name} ({1 / step:.4g} Hz)"
        for name, step in zip(recordings.sources, usual, strict=True)
        if step * control_hz > MOST * (1 + _SAME)
    ]
    if dense:
        problems.append(
            f"{control_hz:g} Hz is more than twice the rate of {some(dense)}: {option('resample')} may be at"
            f" most {MOST / max(usual):.4g}, else most frames would be interpolated"
        )
    problems += unfit
    if not unfit and recordings.num_labels and None in summing:
        problems.append(
            "actions of kind 'delta' may be changes over one frame, which add up over a longer step, or velocities,"
            f" which are held: pass {option('action_kind')} 'change' or 'velocity', or 'raw' for torques"
        )
    refuse("these recordings", problems)
    adding = np.array(summing, dtype=bool)
    columns = np.concatenate(recordings.states).T
    switches = [bool((each == each.round()).all()) and len(np.unique(each)) <= _LEVELS for each in columns]
    bounds = np.where(switches, 0, leap_bounds(recordings.states)[0])
    starts = quaternion_starts(recordings.states)
    parts: list[tuple[str, np.ndarray, np.ndarray, int, np.ndarray]] = []
    gaps: list[str] = []
    short: list[str] = []
    each = zip(recordings.sources, recordings.states, recordings.actions, times, usual, strict=True)
    for number, (name, frames, steps, at, step) in enumerate(each):
        breaks = np.flatnonzero(np.diff(at) > GAP * max(step, 1 / control_hz))
        gaps += [f"{name} ({at[before + 1] - at[before]:.3g} s)" for before in breaks]
        edges = [0, *(breaks + 1), len(at)]
        for part, (start, end) in enumerate(zip(edges, edges[1:], strict=False)):
            called, span = f"{name}[{part}]" if len(breaks) else name, slice(start, end)
            new = at[start] + np.arange(int((at[end - 1] - at[start]) * control_hz + ROUNDED) + 1) / control_hz
            if len(new) < 2:
                short.append(called)
                continue
            labels = _actions(steps[start : end - 1], at[span], new, adding, UNEVEN * step)
            rows = start + np.searchsorted((at[span][1:] + at[span][:-1]) / 2, new)
            parts.append((called, _states(frames[span], at[span], new, bounds, starts), labels, number, rows))
    if not parts:
        raise DataError("these recordings", f"no trajectory has two frames at {control_hz:g} Hz")
    notes = [f"{len(gaps)} gaps in time, where trajectories were split: {some(gaps)}"] if gaps else []
    notes += [f"{len(short)} trajectories without two frames at {control_hz:g} Hz: {some(short)}"] if short else []
    names, states, actions, numbers, nearest = zip(*parts, strict=True)
    return replace(
        recordings,
        states=list(states),
        actions=list(actions),
        sources=names,
        control_hz=float(control_hz),
        cameras=recordings.filmed(zip(numbers, nearest, strict=True)),
        skipped=(*recordings.skipped, *notes),
    )


def leap_bounds(trajectories: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the step above which a column leaps, and its median step, infinite if it never moves: both ``[d]``."""
    steps = np.abs(np.concatenate([np.diff(frames, axis=0) for frames in trajectories]))
    spans = np.ptp(np.concatenate(trajectories), axis=0)
    usual = np.array([np.median(moved) if len(moved := step[step > 0]) else np.inf for step in steps.T])
    return np.maximum(LEAP * spans, UNUSUAL * usual), usual


def quaternion_starts(trajectories: Sequence[np.ndarray]) -> list[int]:
    """Returns the first columns of quaternions in ``[T_i, d]``: four neighbouring columns, norm 1 in most frames."""
    return [
        start
        for start in range(trajectories[0].shape[1] - 3)
        if all(
            (np.abs(np.linalg.norm(rows[:, start : start + 4], axis=1) - 1) <= _UNIT).mean() > _MOSTLY
            for rows in trajectories
        )
    ]


def sign_flips(frames: np.ndarray, starts: Sequence[int]) -> np.ndarray:
    """Marks the steps ``[T - 1, d]`` in which a quaternion of four columns changes sign."""
    flips = np.zeros((len(frames) - 1, frames.shape[1]), dtype=bool)
    for start in starts:
        turn = frames[:, start : start + 4]
        flips[:, start : start + 4] |= ((turn[1:] * turn[:-1]).sum(1) < 0)[:, None]
    return flips


def _states(
    frames: np.ndarray, times: np.ndarray, new: np.ndarray, bounds: np.ndarray, starts: Sequence[int]
) -> np.ndarray:
    """Returns states ``[T, d]`` at new times within the recorded ones."""
    before = np.clip(np.searchsorted(times, new, side="right") - 1, 0, len(times) - 2)
    share = np.clip((new - times[before]) / (times[before + 1] - times[before]), 0, 1)[:, None]
    step = frames[before + 1] - frames[before]
    return np.where(
        (np.abs(step) > bounds) | sign_flips(frames, starts)[before],
        np.where(share < 0.5, frames[before], frames[before + 1]),
        frames[before] + share * step,
    )


def _actions(steps: np.ndarray, times: np.ndarray, new: np.ndarray, adding: np.ndarray, room: float) -> np.ndarray:
    """Returns the actions ``[T - 1, a]`` of the steps between new times: summed or held."""
    held = steps[np.searchsorted(times[:-1], new[:-1] + room, side="right") - 1]
    if not adding.any():
        return held
    unlabelled = np.isnan(steps).any(-1)
    ends = np.concatenate(
        [np.zeros((1, steps.shape[1] + 1)), np.column_stack([np.nan_to_num(steps), unlabelled]).cumsum(0)]
    )
    sums = np.stack([np.diff(np.interp(new, times, column)) for column in ends.T], 1)
    known = (sums[:, -1:] < _SAME) & ~np.isnan(held).any(-1, keepdims=True)
    return np.where(known, np.where(adding, sums[:, :-1], held), np.nan)
