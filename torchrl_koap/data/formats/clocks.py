# This source code is licensed under the MIT license found in the LICENSE file.
"""Time stamps of recordings: the rate that they say, and whether frames lie evenly in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from torchrl_koap.files import option, some

UNEVEN = 0.2  # share of the usual step by which a step in time may differ
SLOWEST, FASTEST = 1.0, 2000.0  # Hz; beyond, stamps are in another unit
ROUNDED = 0.03  # share of its mean step by which a rounded clock's steps may differ
NOT_READ = " (its time stamps are not looked at)"
_LONG = 20  # frames after which a column that rises evenly is taken for a clock


@dataclass(frozen=True)
class Clock:
    """Time stamps of recordings."""

    name: str  # of the column
    times: Sequence[np.ndarray]  # seconds of every trajectory [T_i]
    sources: Sequence[str]  # what messages call the trajectories

    @cached_property
    def steps(self) -> list[np.ndarray]:
        """Seconds between frames ``[T_i - 1]``."""
        return [np.diff(times) for times in self.times]

    @property
    def usual(self) -> float:
        """The median step in seconds."""
        return float(np.median(np.concatenate(self.steps)))


def declared_rate(value: Any) -> float | None:
    """Frames per second that a source declares; None where what it says is no positive number."""
    return float(value) if isinstance(value, (int, float)) and value > 0 else None


def usual_rate(clock: Clock, problems: list[str]) -> float | None:
    """Frames per second by the usual step of time stamps; None, and a problem, where they cannot be seconds."""
    back = [
        f"{name} (frame {int((~(step > 0)).argmax()) + 1})"
        for name, step in zip(clock.sources, clock.steps, strict=True)
        if not (step > 0).all()
    ]
    if back:
        problems.append(
            f"time stamps do not increase, or are missing, in column {clock.name!r} of {len(back)} of"
            f" {len(clock.steps)} trajectories: {some(back)}; pass {option('control_hz')} if they mean nothing"
        )
        return None
    rate, name = 1 / clock.usual, clock.name
    if SLOWEST <= rate <= FASTEST:
        return rate
    problems.append(
        f"column {name!r} says {rate:.3g} frames per second if it is in seconds: name it {name}_ms, {name}_us or"
        f" {name}_ns if it is in another unit, or pass {option('control_hz')}"
    )
    return None


def find_rate(clock: Clock, declared: float | None, problems: list[str]) -> float | None:
    """The rate of frames that lie evenly in time, and agree with what the source declares; else there are problems."""
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
            f"{some(uneven)}; the usual step is {1 / rate:.4g} s: pass {option('resample')} {rate:.3g} to bring"
            f" them to a fixed rate, or {option('control_hz')} if the stamps are wrong"
        )
    if declared is not None and abs(declared / rate - 1) > UNEVEN:
        problems.append(
            f"column {clock.name!r} says {rate:.4g} frames per second, the source declares {declared:g}:"
            f" pass {option('control_hz')}"
        )
    return rate if declared is None else declared


def told_rate(clock: Clock, control_hz: float) -> str:
    """Returns a note if ignored time stamps, of any unit, give no rate, another one or uneven steps; else ""."""
    rate = usual_rate(clock, [])
    if rate is not None and abs(control_hz / rate - 1) > UNEVEN:
        return f" (it says {rate:.4g} frames per second)"
    steps = np.concatenate(clock.steps)
    if (steps > 0).all() and np.abs(steps / clock.usual - 1).max(initial=0) > UNEVEN:
        low, high = steps.min() / clock.usual, steps.max() / clock.usual
        return f" (its frames are {low:.3g} to {high:.3g} usual steps apart)"
    return NOT_READ if rate is None else ""


def rises_evenly(trajectories: Sequence[np.ndarray], *, room: float = ROUNDED) -> bool:
    """Says whether a column, given by trajectory ``[T_i]``, rises in every frame as clocks do.

    Keyword Args:
        room (float): share of the mean step by which steps may differ. Default: what rounding leaves.
    """
    steps = np.concatenate([np.diff(values.astype(np.float64)) for values in trajectories])
    if len(steps) < _LONG or steps.min() <= 0:
        return False
    return bool(np.abs(steps / steps.mean() - 1).max() <= room)
