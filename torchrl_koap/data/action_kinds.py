# This source code is licensed under the MIT license found in the LICENSE file.
"""Guesses the kind of actions from their labels, and warns where their task declares another kind."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data.formats.resampling import quaternion_starts
from torchrl_koap.files import option, some
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.action_rules import ActionKind

NEAR, NAMED = 0.3, 1.0  # targets lie within this share of a column's spread; NAMED if action and column share a name
NEARER = 3.0  # one reading of an action is this many times closer than the other
CLEARER = 2.0  # one reading leaves this many times less unexplained than the other
ASTRAY = 5.0  # times as far from its target as in half of the recordings: another order or unit of columns
FOLLOWS = 0.8  # above this correlation with a change, an action is a delta even if a level correlates as well
UNLIKE = 0.5  # a command column that correlates less than this with every action repeats no command
REPEATS = 1e-5  # a column repeats an action within this share of its range
SPEED = 0.01  # a column is the speed of another within this share of its spread
FEW, MANY = 20, 20_000  # fewest labels to judge by; most labels that are read


@dataclass(frozen=True)
class LikelyKind:
    """Likely kind of an action column, by its labels."""

    kind: ActionKind  # "absolute": near a state column; "delta": follows the change of one; "raw": neither
    column: int  # nearest state column, in units of that column's spread
    distance: float  # mean distance from that column
    follows_column: float  # largest correlation with a state column, between 0 and 1
    follows_change: float  # largest correlation with the change of one


@dataclass(frozen=True)
class _Labels:
    """Labelled steps."""

    actions: np.ndarray  # [n, a]
    level: np.ndarray  # [n, d]: state columns of the next frame
    change: np.ndarray  # [n, d]: their change over the step
    names: list[str]  # of the columns
    turns: list[tuple[int, int, int]]  # quaternions: first action, first target column, number of labels of other sign
    episodes: np.ndarray  # [n]: number of the recording


def likely_kinds(data: TensorDictBase, task: Task) -> dict[str, LikelyKind]:
    """Guesses the kind of every action of flat data ``[N]``, by name; no constant actions, none below 20 labels."""
    labels = _labels(data, task)
    return {} if labels is None else _likely(labels, task)


def kind_warnings(data: TensorDictBase, task: Task, called: Sequence[str]) -> Iterator[str]:
    """Finds actions of flat data ``[N]`` that contradict their kind; ``called`` are the names of recordings.

    * Quaternion targets: the sign differs from that of the state.
    * ``"delta"``: near the next value of a state column, following columns more than their changes, or only two values.
    * ``"absolute"``: near the change of their column (per frame or second), or far from it in half or some recordings.
    * ``"raw"``: all near columns, or all following changes.
    * All but ``"absolute"`` and switches: equal to a state column of the next frame, no speed, in every label.
    """
    labels = _labels(data, task)
    if labels is None:
        return
    likely = _likely(labels, task)
    for start, column, against in labels.turns:
        if against:
            yield (
                f"actions {', '.join([*task.actions][start : start + 4])} are a quaternion of the other sign than"
                f" {', '.join(labels.names[column : column + 4])} in {against} of {len(labels.actions)} labels: first"
                " correct the signs of the state, then negate the action where the dot product of both is negative"
            )
    yield from _targets_far_away(labels, task, likely, called)
    kinds = {name: action.kind for name, action in task.actions.items()}
    aimed = {name for name, each in likely.items() if each.kind == "absolute"}
    levels = {name: len(np.unique(steps)) for name, steps in zip(kinds, labels.actions.T, strict=True)}
    switches = [name for name, kind in kinds.items() if kind == "delta" and levels[name] == 2]
    wrong = {name for name in aimed if kinds[name] == "delta" and name not in switches}
    wrong |= aimed if len(aimed) == task.action_dim and set(kinds.values()) == {"raw"} else set()
    found = {name: likely[name] for name in wrong} | {name: replace(likely[name], kind="raw") for name in switches}
    if wrong:  # "delta" was probably the default then, so other actions that look raw are reported too
        found |= {name: each for name, each in likely.items() if kinds[name] == "delta" and each.kind == "raw"}
    cure = _cure(task, labels, found)
    if wrong:
        reached = [labels.names[likely[name].column] for name in kinds if name in wrong]
        yield (
            f"actions lie within {max(likely[name].distance for name in wrong):.2g} of {some(reached)} on average: they"
            f" look like absolute targets; {cure}"
        )
    if switches:
        yield f"{some(switches)}: an action with two values, such as open and close of a gripper: {cure}"
    told = [levels[name] > 2 and kind != "absolute" and name not in wrong for name, kind in kinds.items()]
    if repeated := _repeated(labels, told, task.control_hz):
        yield (
            f"columns {some(repeated)} repeat the last action, so states without labels hold actions as well: if they"
            f" are commands, name them in {option('command')}"
        )
    wrong.update(found)
    changes = [each for name, each in likely.items() if kinds[name] == "delta" and name not in wrong]
    still = [each for each in changes if each.kind == "raw" and _clear(each.follows_column, each.follows_change)]
    if 2 * len(still) > len(changes):
        yield (
            f"{len(still)} of {task.action_dim} actions follow state columns rather than their changes"
            f" ({_correlations(still)}): they look like neither changes nor targets; convert again with"
            " --action-kind raw"
        )
    raw = [each for name, each in likely.items() if kinds[name] == "raw"]
    if len(raw) == task.action_dim and all(each.kind == "delta" for each in raw):
        yield f"actions follow changes of columns ({_correlations(raw)}): convert again with --action-kind delta"


def command_warnings(data: TensorDictBase, task: Task) -> Iterator[str]:
    """Finds command columns of flat data ``[N]`` whose values and changes correlate with no action."""
    steps = _labelled_steps(data)
    if task.command_columns is None or steps is None:
        return
    before, after, actions, _ = steps
    for column in range(*task.command_columns.indices(task.observation_dim)):
        read = [values for values in (after[:, column], (after - before)[:, column]) if np.ptp(values)]
        most = max([_correlation(values, actions).max() for values in read], default=1.0)
        if most < UNLIKE:
            yield (
                f"command column {task.observation_names[column]!r} follows no action (largest correlation"
                f" {most:.2f}), yet it is hidden from planner and controller; a signal that the robot follows, such as"
                f" a joystick, is not a {option('command')}"
            )


def describe_likely(likely: dict[str, LikelyKind]) -> str:
    """Returns the result of :func:`likely_kinds` as text."""
    found: dict[str, list[str]] = {}
    for name, each in likely.items():
        found.setdefault(each.kind, []).append(name)
    said = {"absolute": "near a column", "delta": "near the change of a column", "raw": "near neither"}
    return "; ".join(
        f"{kind}: {some(names)} ({said[kind]}; {_correlations([likely[name] for name in names])})"
        for kind, names in found.items()
    )


def _labelled_steps(data: TensorDictBase) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns observations before and after labels ``[n, obs]``, actions ``[n, a]``, episodes ``[n]``; None if few."""
    labelled = data.get(keys.HAS_ACTION).squeeze(-1).nonzero().squeeze(-1)
    if len(labelled) < FEW:
        return None
    rows = data[labelled[:: 1 + len(labelled) // MANY]]
    read = (keys.OBSERVATION, keys.NEXT_OBSERVATION, keys.ACTION)
    before, after, actions = (rows.get(key).double().cpu().numpy() for key in read)
    return before, after, actions, rows.get(keys.EPISODE).flatten().cpu().numpy()


def _labels(data: TensorDictBase, task: Task) -> _Labels | None:
    steps = _labelled_steps(data)
    if steps is None:
        return None
    before, after, actions, episodes = steps
    origin, added = map(np.asarray, task.origins or (0.0, 0.0))
    before, after, level = (task.state_of(torch.from_numpy(seen)).numpy() for seen in (before, after, after + origin))
    actions, turns, names = actions + added, [], list(task.state_names)
    for start in quaternion_starts([actions]):
        turn, near = actions[:, start : start + 4], dict[int, tuple[float, np.ndarray]]()
        for column in quaternion_starts([level]):
            there = level[:, column : column + 4]
            products = (turn * there).sum(1)
            other = np.abs((turn * np.roll(there, len(there) // 2, axis=0)).sum(1))  # the product by chance
            apart = float((1 - np.abs(products)).mean())
            if apart < NEAR * (1 - other).mean():
                near[column] = apart, products
        if near:
            column = min(near, key=lambda column: near[column][0])  # a goal may be near as well
            turns.append((start, column, int((near[column][1] < 0).sum())))
            turn *= np.where(near[column][1] < 0, -1, 1)[:, None]
    return _Labels(actions, level, after - before, names, turns, episodes)


def _likely(labels: _Labels, task: Task) -> dict[str, LikelyKind]:
    found: dict[str, LikelyKind] = {}
    spread, rates = labels.level.std(0), labels.change * task.control_hz
    speeds = [np.abs(column[:, None] - rates).mean(0).min() for column in labels.level.T] <= NEAR * spread
    for name, steps in zip(task.actions, labels.actions.T, strict=True):
        if not np.ptp(steps):
            continue
        level, change = (_correlation(steps, columns) for columns in (labels.level, labels.change))
        change = np.where(speeds, 0.0, change)  # torques change the speed
        distance, *others = (np.abs(steps[:, None] - there).mean(0) for there in _readings(labels, task))
        room = np.where([column == name for column in labels.names], NAMED, NEAR) * spread
        moves = min(map(np.min, others)) <= NEAR * steps.std()
        fits = np.flatnonzero((distance < room) & _clear(level, change.max()) & (not moves))
        share = np.divide(distance, room, out=np.full_like(room, np.inf), where=room > 0)
        moves = moves or change.max() > FOLLOWS or _clear(change.max(), level.max())
        kind: ActionKind = "absolute" if len(fits) else "delta" if moves else "raw"
        column = int(fits[share[fits].argmin()] if len(fits) else share.argmin())
        found[name] = LikelyKind(kind, column, float(distance[column]), float(level.max()), float(change.max()))
    for start, column, _ in labels.turns:  # all four parts are targets, also those near 0
        for name, at in zip([*task.actions][start : start + 4], range(column, column + 4), strict=True):
            found[name] = replace(found.get(name, LikelyKind("raw", 0, 0.0, 0.0, 0.0)), kind="absolute", column=at)
    return found


def _cure(task: Task, labels: _Labels, found: Mapping[str, LikelyKind]) -> str:
    """Returns the options to convert again with, where actions are of another kind or target another column."""
    actions = {name: found.get(name, action) for name, action in task.actions.items()}
    kinds = [action.kind for action in actions.values()]
    targets = [action.column for action in actions.values() if action.kind == "absolute"]
    asked = f"convert again with --action-kind {kinds[0] if len(set(kinds)) == 1 else ' '.join(kinds)}"
    if targets == list(task.robot) or not targets:
        return asked
    return f"{asked} --targets {shlex.join([labels.names[column] for column in targets if column is not None])}"


def _targets_far_away(
    labels: _Labels, task: Task, likely: Mapping[str, LikelyKind], called: Sequence[str]
) -> Iterator[str]:
    """Finds absolute actions that are nearer to the change of their column, or farther from it than the column moves.

    If half of the recordings show this, the action has another kind; if fewer, their columns another order or unit.
    """
    far: dict[str, str] = {}
    astray: dict[str, set[int]] = {}
    recordings = np.unique(labels.episodes)
    parts = [labels.episodes == number for number in recordings]
    for (name, action), steps in zip(task.actions.items(), labels.actions.T, strict=True):
        if action.kind != "absolute" or action.column is None or name not in likely:
            continue
        level, target = labels.level[:, action.column], labels.names[action.column]
        distances = [np.abs(steps - there[:, action.column]) for there in _readings(labels, task)]
        each = np.array([distances[0][part].mean() for part in parts])
        usual, *others = (np.median([distance[part].mean() for part in parts]) for distance in distances)
        if NEARER * min(others) < usual or min(usual, (steps - level).std()) > NAMED * level.std():
            far[name] = f"{name!r} by {usual:.2g} from {target!r}"
        elif (odd := (each > ASTRAY * usual) & (each > NEAR * level.std())).any():
            astray[f"{name!r} by {each[odd].min():.2g} from {target!r}, elsewhere by {usual:.2g}"] = {*recordings[odd]}
    if far:
        cure = _cure(task, labels, {name: likely[name] for name in far})
        yield f"absolute actions lie far from their targets on average, {some([*far.values()])}: {cure}"
    if astray:
        where = some([called[number] for number in sorted(set().union(*astray.values()))])
        yield f"absolute actions lie far from their targets in {where}, {some([*astray])}: another order or unit?"


def _repeated(labels: _Labels, chosen: Sequence[bool], control_hz: float) -> list[str]:
    """Returns the state columns that equal one of the chosen actions in every label, and are no speed of a column."""
    actions, level = labels.actions[:, chosen], labels.level[:, :, None]
    same = (np.abs(level - actions[:, None]).max(0) <= REPEATS * np.ptp(actions, axis=0)).any(1)
    same &= np.abs(level - control_hz * labels.change[:, None]).mean(0).min(1) > SPEED * labels.level.std(0)
    return [name for name, repeats in zip(labels.names, same, strict=True) if repeats]


def _readings(labels: _Labels, task: Task) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns what actions may be equal to: the next state columns, their changes per frame, and these per second."""
    return labels.level, labels.change, labels.change * task.control_hz


def _correlation(steps: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Returns the absolute correlation of an action ``[n]`` with columns ``[n, d]``; 0 for constant columns."""
    columns = columns - columns.mean(0)
    size = np.sqrt((columns**2).mean(0))
    moves = size > 1e-12 * np.abs(columns).max(initial=1.0)
    return np.abs((steps - steps.mean()) @ columns / len(steps)) / np.where(moves, steps.std() * size, np.inf)


def _clear(one: np.ndarray | float, other: np.ndarray | float) -> np.ndarray | bool:
    """Checks whether one correlation explains an action clearly better than the other."""
    return CLEARER * (1 - one) < 1 - other


def _correlations(likely: list[LikelyKind]) -> str:
    columns, changes = np.mean([(each.follows_column, each.follows_change) for each in likely], axis=0)
    return f"mean correlation {columns:.2f} with a column, {changes:.2f} with its change"
