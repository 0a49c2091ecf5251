# This source code is licensed under the MIT license found in the LICENSE file.
"""Disturbs scripted operators, so that demonstrations show how mistakes are corrected.

After Laskey et al., "DART: Noise Injection for Robust Imitation Learning", 2017. A disturbed step changes the command
that is executed and recorded. Kinds of disturbances, for several control steps each::

    impulse      the command is pushed in a random direction
    slip         the command turns to one side of the operator's direction
    late_turn    the operator repeats its previous action
    drift        a tool on the table slowly sinks or rises, if an action commands its height
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_koap.tasks import Task

KINDS = ("impulse", "slip", "late_turn", "drift")
_SIDEWAYS = KINDS[:3]
# last numbers in seeds. Numpy appends zeros to seeds: the choice shares its stream with the expert of episode 3
_STREAM, _CHOICE_STREAM, _HEIGHT_STREAM = 2, 3, 4
_QUIET, _MEAN_GAP = 12, 45  # control steps to the next disturbance: minimum, and mean of what is added
# duration in control steps, low and high end
_STEPS = {"impulse": (2, 6), "slip": (4, 11), "late_turn": (4, 11), "drift": (4, 11)}
_SLIP = (0.6, 1.4)  # angle (rad)
_DRIFT = (0.1, 0.35)  # speed, as a share of the operator's step size
_MEMORY = 0.98  # decay of the operator's step size per control step


def choose_disturbed(episodes: int, share: float, seed: int) -> np.ndarray:
    """Draws which episodes are disturbed, bool ``[episodes]``; a draw does not depend on their number."""
    if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0 <= share <= 1:
        raise ValueError(f"disturbance must be the share of disturbed episodes, 0 to 1, got {share!r}")
    return np.random.default_rng((seed, _CHOICE_STREAM)).random(episodes) < share


class Disturbances:
    """Disturbs the actions of a batch of operators, in proportion to the operator's own steps so far.

    Actions that are no change of a command (the gripper) stay the same. The height of a tool on the table only drifts;
    from demonstrations that never lift the tool, a controller could not learn to lift it. Every episode has a seed, a
    tuple of integers, and a flag in ``disturbed``.
    """

    def __init__(self, task: Task, seeds: Sequence, disturbed: Sequence[bool]):
        self._hands = [_Hand(seed, task) if each else None for seed, each in zip(seeds, disturbed, strict=True)]

    def disturb(self, action: np.ndarray) -> np.ndarray:
        """Returns the actions ``[n, act]`` that are executed in place of the operators' ``action`` ``[n, act]``."""
        rows = zip(self._hands, action, strict=True)
        return np.stack([wanted if hand is None else hand.disturb(wanted) for hand, wanted in rows])

    @property
    def spells(self) -> list[list[tuple[int, int, str]]]:
        """Disturbances of every episode so far: first control step, the one after the last, kind."""
        return [[] if hand is None else sorted(hand.spells) for hand in self._hands]


def disturbed_columns(task: Task) -> np.ndarray:
    """Returns the disturbed action columns: changes of a command, for a tool on the table only sideways ones."""
    changes = task.delta_actions
    if not changes:
        raise ValueError(f"task {task.name!r} has no action that is a change of a command: nothing can be disturbed")
    joints = [index for index in changes if task.action_units[index] == "rad"]
    return np.array(joints or changes[:2])


def height_column(task: Task) -> int | None:
    """Returns the action column that changes the height of a tool on the table; None if there is none."""
    lengths = [index for index, unit in enumerate(task.action_units) if unit == "m"]
    return lengths[2] if len(lengths) == 3 and list(disturbed_columns(task)) == lengths[:2] else None


def _spell(now: int, draw: np.random.Generator, kinds: Sequence[str]) -> tuple[int, int, str]:
    """Draws the next disturbance: first control step, the one after the last, kind."""
    start = now + _QUIET + int(draw.exponential(_MEAN_GAP))
    kind = kinds[draw.integers(len(kinds))]
    return start, start + int(draw.integers(*_STEPS[kind])), kind


class _Hand:
    """Disturbances of one episode: sideways ones, and drifts of the height."""

    def __init__(self, seed: tuple[int, ...], task: Task):
        self._columns, self._height = disturbed_columns(task), height_column(task)
        self._width = len(self._columns)
        self._sideways, self._upwards = (np.random.default_rng((*seed, own)) for own in (_STREAM, _HEIGHT_STREAM))
        self._time, self._pace = 0, 0.0
        self._held, self._last = np.zeros(self._width), np.zeros(self._width)
        self.spells: list[tuple[int, int, str]] = []
        self._plan()
        self._plan_drift()

    def _plan(self) -> None:
        draw = self._sideways
        self._spell = _spell(self._time, draw, _SIDEWAYS)
        direction = draw.normal(size=self._width)
        self._push = draw.uniform(0.7, 1.4) * direction / np.linalg.norm(direction)
        self._turn = draw.uniform(*_SLIP) * draw.choice((-1.0, 1.0))
        self._share = draw.uniform(-1.0, 1.0, self._width)

    def _plan_drift(self) -> None:
        draw = self._upwards
        self._drift = _spell(self._time, draw, ("drift",))
        self._rate = draw.uniform(*_DRIFT) * draw.choice((-1.0, 1.0))

    def disturb(self, action: np.ndarray) -> np.ndarray:
        wanted, done = action[self._columns], action.copy()
        self._pace = max(float(np.linalg.norm(wanted)), _MEMORY * self._pace)
        (start, end, kind), (drift_start, drift_end, _) = self._spell, self._drift
        if self._time == start:
            self._held = self._last.copy()
            self.spells.append(self._spell)
        if self._time >= start:
            pushed = wanted + self._pace * self._push
            done[self._columns] = {"impulse": pushed, "slip": self._slip(wanted), "late_turn": self._held}[kind]
        if self._height is not None and self._time >= drift_start:
            done[self._height] = self._pace * self._rate
            if self._time == drift_start:
                self.spells.append(self._drift)
        self._last = wanted
        self._time += 1
        if self._time >= end:
            self._plan()
        if self._time >= drift_end:
            self._plan_drift()
        return done

    def _slip(self, wanted: np.ndarray) -> np.ndarray:
        if self._width != 2:  # no unique sideways direction: a push in proportion to the speed
            return wanted + 0.5 * np.linalg.norm(wanted) * self._share
        c, s = np.cos(self._turn), np.sin(self._turn)
        return np.array([c * wanted[0] - s * wanted[1], s * wanted[0] + c * wanted[1]])
