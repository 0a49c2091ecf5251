# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads the frame rate from time stamps of recordings and checks that frames are evenly spaced in time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from torchrl_koap.data.formats.kinds import names_unit
from torchrl_koap.files import option, some

UNEVEN = 0.2  # share of the usual step by which a step in time may differ
SLOWEST, FASTEST = 1.0, 2000.0  # Hz; outside, the name of stamps must give their unit
ROUNDED = 0.03  # share of its mean step by which a rounded clock's steps may differ
NOT_READ = " (its time stamps are ignored)"
_SAME = 1e-3  # share of a step by which its median and mean differ if the clock is not rounded
_LONG = 20  # steps that a column must rise evenly to be taken for a clock


@dataclass(frozen=True)
class Clock:
    """Time stamps of recordings."""

    name: str  # of the column
    times: Sequence[np.ndarray]  # seconds of every trajectory [T_i]
    sources: Sequence[str]  # names of the trajectories, for messages

    @cached_property
    def steps(self) -> list[np.ndarray]:
        """Seconds between frames ``[T_i - 1]``."""
        return [np.diff(times) for times in self.times]

    @property
    def usual(self) -> float:
        """The median step in seconds; the mean of the steps near it if the clock is rounded, as 33 and 34 ms are."""
        steps = np.concatenate(self.steps)
        median = float(np.median(steps))
        near = steps[np.abs(steps - median) <= UNEVEN * abs(median)]  # none between two rates
        mean = float(near.mean()) if len(near) else median
        return mean if abs(mean - median) > _SAME * abs(median) else median


def time_stamps(columns: Sequence[Mapping[str, np.ndarray]]) -> dict[str, list[np.ndarray]]:
    """Adds nanoseconds to the seconds beside them, as ROS stores both: columns in seconds by name per trajectory."""
    found: dict[str, list[np.ndarray]] = {}
    for name in columns[0]:
        times = [clocks[name] for clocks in columns]
        other = next((other for other, held in found.items() if _parted(held, times) or _parted(times, held)), None)
        if other is None:
            found[name] = times
        else:
            found[other] = [part + rest for part, rest in zip(found[other], times, strict=True)]
    return found


def clocks_of(columns: Sequence[Mapping[str, np.ndarray]], sources: Sequence[str]) -> list[Clock]:
    """Returns time stamps, given in seconds by name for every trajectory, from the first frame of each."""
    found = time_stamps(columns)
    return [Clock(name, [part - part[:1] for part in times], sources) for name, times in found.items()]


def _parted(seconds: Sequence[np.ndarray], rest: Sequence[np.ndarray]) -> bool:
    """Checks whether two clocks are whole seconds and the rest of each, as in ROS."""
    whole = all((part == part.round()).all() for part in seconds)
    return whole and all(((part >= 0) & (part < 1)).all() for part in rest)


def declared_rate(value: Any) -> float | None:
    """Returns the frames per second that a source declares; None if the value is no positive number."""
    return float(value) if isinstance(value, (int, float)) and 0 < value < math.inf else None


def usual_rate(clock: Clock, problems: list[str]) -> float | None:
    """Returns frames per second by the median step of time stamps.

    Returns None, and adds a problem, if stamps do not increase, or have no unit in their name and cannot be seconds.
    """
    back = [
        f"{name} (frame {int((~(step > 0)).argmax()) + 1})"
        for name, step in zip(clock.sources, clock.steps, strict=True)
        if not (step > 0).all()
    ]
    if back:
        problems.append(
            f"time stamps do not increase, or are missing, in column {clock.name!r} of {len(back)} of"
            f" {len(clock.steps)} trajectories: {some(back)}; pass {option('control_hz')} to ignore them"
        )
        return None
    rate, name = 1 / clock.usual, clock.name
    if SLOWEST <= rate <= FASTEST or names_unit(name):
        return rate
    problems.append(
        f"column {name!r} gives {rate:.3g} frames per second if it is in seconds: name it {name}_s if it is,"
        f" {name}_ms, {name}_us or {name}_ns if it is in another unit, or pass {option('control_hz')}"
    )
    return None


def find_rate(clock: Clock, declared: float | None, problems: list[str]) -> float | None:
    """Returns the frame rate; adds problems if frames are uneven in time or disagree with the declared rate."""
    rate = usual_rate(clock, problems)
    if rate is None:
        return None
    uneven = [
        f"{name}: frames are {step.min():.4g} to {step.max():.4g} s apart (frame {np.abs(step - 1 / rate).argmax()})"
        for name, step in zip(clock.sources, clock.steps, strict=True)
        if np.abs(step * rate - 1).max(initial=0) > UNEVEN
    ]
    if uneven:
        problems.append(
            f"{some(uneven)}; the usual step is {1 / rate:.4g} s: pass {option('resample')} {rate:.3g} for a"
            f" fixed rate, or {option('control_hz')} if the stamps are wrong"
        )
    if declared is not None and abs(declared / rate - 1) > UNEVEN:
        problems.append(
            f"column {clock.name!r} gives {rate:.4g} frames per second, the source declares {declared:g}:"
            f" pass {option('control_hz')}"
        )
    return rate if declared is None else declared


def told_rate(clock: Clock, control_hz: float) -> str:
    """Returns a note if ignored time stamps, of any unit, give no rate, another rate or uneven steps; else ""."""
    rate = usual_rate(clock, [])
    if rate is not None and abs(control_hz / rate - 1) > UNEVEN:
        return f" (it says {rate:.4g} frames per second)"
    steps = np.concatenate(clock.steps)
    if (steps > 0).all() and np.abs(steps / clock.usual - 1).max(initial=0) > UNEVEN:
        low, high = steps.min() / clock.usual, steps.max() / clock.usual
        return f" (its frames are {low:.3g} to {high:.3g} usual steps apart)"
    return NOT_READ if rate is None else ""


def rises_evenly(trajectories: Sequence[np.ndarray], *, room: float = ROUNDED, least: int = _LONG) -> bool:
    """Checks whether a column, given by trajectory ``[T_i]``, rises in every frame as clocks do.

    Keyword Args:
        room (float): share of the mean step by which steps may differ. Default: the size of rounding errors.
        least (int): fewest steps to judge by.
    """
    steps = np.concatenate([np.diff(values.astype(np.float64)) for values in trajectories])
    if len(steps) < least or steps.min() <= 0:
        return False
    return bool(np.abs(steps / steps.mean() - 1).max() <= room)
