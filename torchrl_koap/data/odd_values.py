# This source code is licensed under the MIT license found in the LICENSE file.
"""Warns of unlikely numbers in columns: leaps, marks of missing values, other units, quaternion signs, angle turns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchrl_koap.data.formats.resampling import UNUSUAL, leap_bounds, quaternion_starts, sign_flips
from torchrl_koap.files import some

MARK_DISTANCE, MARK_COUNT = 10.0, 3  # a mark: this many ranges of the other values away, and at least this frequent
FILLS = 0.1  # a wrapped counter has at least this share of its values in the middle half of its range
OTHER = 20.0  # times as far as in most trajectories
AFAR = 0.1  # warn above this share of unlabelled trajectories that differ from the labelled ones
SPEED = 0.97  # a speed: correlated more than this with the changes of another column
LESS = 10.0  # at rest: this many times less motion than with labels, not none, because of sensor noise


def leap_warnings(trajectories: Sequence[np.ndarray], called: Sequence[str], names: Sequence[str]) -> list[str]:
    """Finds columns of ``[T_i, d]`` whose largest step is above 1/3 of their range and twenty times the usual one.

    The warnings name a likely cause and a remedy. Sign changes of quaternions are left to :func:`quaternion_warnings`.
    """
    bound, usual = leap_bounds(trajectories)
    rows = np.concatenate(trajectories)
    low, high = rows.min(0), rows.max(0)
    fills = (np.abs(rows - (low + high) / 2) < (high - low) / 4).mean(0) > FILLS  # not a spike, nor two levels
    found: dict[str, list[str]] = {}
    starts = quaternion_starts(trajectories)
    leaps = [(np.abs(np.diff(frames, axis=0)) > bound) & ~sign_flips(frames, starts) for frames in trajectories]
    for column, name in enumerate(names):
        steps = [
            (frames, source, at)
            for frames, source, leap in zip(trajectories, called, leaps, strict=True)
            for at in np.flatnonzero(leap[:, column])
        ]
        if not steps:
            continue
        frames, source, at = steps[0]
        before, after = frames[at : at + 2]
        leaping = (np.abs(after - before) > bound).mean()
        flipped = (np.abs(after + before) < UNUSUAL * usual) & (np.abs(after - before) > UNUSUAL * usual)
        ends = np.sort(frames[at : at + 2, column]) - [low[column], high[column]]
        reach = (high - low)[column]
        wraps = bool((np.abs(ends) < 0.05 * reach).all() and fills[column])
        near = UNUSUAL * usual[column]
        start, end = (np.stack([path[step + late] for path, _, step in steps]) for late in (0, 1))
        if _turns_over(start, end, column):
            why = "a rotation vector, whose axis flips at pi? give quaternions or 6-D rotations; do not unwrap it"
        else:
            why = _cause(frames[at : at + 3, column], near, flipped.sum() > 1, leaping > 0.5, wraps)
        said = f"from {frames[at, column]:.3g} to {frames[at + 1, column]:.3g} (frame {at + 1} of {source}"
        found.setdefault(why, []).append(f"{name!r} {said}{_more(steps)})")
    return [f"columns leap: {some(which)}: {why}" for why, which in found.items()]


def _more(found: Sequence[object]) -> str:
    return f" and {len(found) - 1} times more" if len(found) > 1 else ""


def _turns_over(before: np.ndarray, after: np.ndarray, column: int) -> bool:
    """Checks by leaps ``[n, d]`` whether three neighbouring columns are a rotation vector whose axis flips at pi."""
    for start in range(max(column - 2, 0), min(column, before.shape[1] - 3) + 1):
        vector, reached = before[:, start : start + 3], after[:, start : start + 3]
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        error = reached - vector * (1 - 2 * np.pi / np.maximum(length, 1))
        others = np.delete(reached - vector, column - start, axis=1)  # the error if the column leapt alone
        if (length <= 1.1 * np.pi).all() and 2 * np.abs(error).sum() < np.abs(others).sum():
            return True
    return False


def _cause(values: np.ndarray, near: float, flipped: bool, most: bool, wraps: bool) -> str:
    """Returns a likely cause of a leap between the first two of three values, and the remedy."""
    leap = abs(values[1] - values[0])
    turn = next((turn for turn in (2 * np.pi, 360.0) if abs(leap - turn) < max(near, 0.1 * turn)), None)
    if turn is not None:
        return f"angles wrapped by {turn:.3g}? np.unwrap them, or give their sine and cosine"
    if flipped and leap <= 2 + near:
        return "a quaternion that changes sign? negate it where its dot product with the previous frame is negative"
    if len(values) > 2 and abs(values[2] - values[0]) < near:
        return "a measurement that failed for a frame? fill it from its neighbours"
    if most:
        return "two episodes in one trajectory? split them, or mark their ends (a column 'episode_index' or 'timeouts')"
    if wraps:
        return f"a counter or an angle wrapped by {leap:.3g}? np.unwrap it with that period"
    return (
        "a switch, or a measurement that failed? fill it from its neighbours, or leave it out; grippers and scans may"
        " leap; where the robot was reset, mark the end of an episode (a column 'episode_index' or 'timeouts')"
    )


def quaternion_warnings(trajectories: Sequence[np.ndarray], names: Sequence[str]) -> Iterator[str]:
    """Finds quaternions, four neighbouring columns of norm 1, whose sign changes in or between trajectories."""
    for start in quaternion_starts(trajectories):
        turns = [frames[:, start : start + 4] for frames in trajectories]
        flips = sum(int(sign_flips(turn, [0])[:, 0].sum()) for turn in turns)
        opposite = sum(bool(np.linalg.norm(turn[0] + turns[0][0]) < 0.5) for turn in turns)
        if flips or opposite:
            yield (
                f"columns {', '.join(names[start : start + 4])} are a quaternion that changes sign in {flips} frames;"
                f" {opposite} trajectories start with the other sign than the first: negate it where its dot product"
                " with the previous frame (in first frames: with the first of all) is negative, also on the robot"
            )


def turn_warnings(trajectories: Sequence[np.ndarray], names: Sequence[str]) -> Iterator[str]:
    """Finds angles that some trajectories record a full turn above all others."""
    if len(trajectories) < 2:
        return
    low, high = (np.stack([end(frames, axis=0) for frames in trajectories]) for end in (np.min, np.max))
    for column, name in enumerate(names):
        order = np.argsort(low[:, column])
        bottom, top = low[order, column], np.maximum.accumulate(high[order, column])
        gap = bottom[1:] - top[:-1]
        at = int(gap.argmax())
        apart = (bottom[at + 1] + top[-1] - bottom[0] - top[at]) / 2
        for turn in (2 * np.pi, 360.0):
            if gap[at] > turn / 2 and abs(apart - turn) < turn / 8:
                yield (
                    f"column {name!r} lies within {bottom[0]:.3g} to {top[at]:.3g} in {at + 1} trajectories and about"
                    f" {turn:.3g} higher in all others: the same angle? add {turn:.3g} to the lower ones, also on the"
                    " robot, or give sine and cosine"
                )


def mark_warnings(rows: np.ndarray, names: Sequence[str], kind: str) -> Iterator[str]:
    """Finds numbers of ``[N, d]`` that repeat far from all others: marks of missing values.

    ``kind`` is ``"column"`` or ``"action"``.
    """
    for name, values in zip(names, rows.T, strict=True):
        levels, counts = np.unique(values, return_counts=True)
        for mark, others in ((0, levels[1:]), (-1, levels[:-1])):
            far = len(others) > MARK_COUNT and np.abs(others - levels[mark]).min() > MARK_DISTANCE * np.ptp(others)
            if far and counts[mark] >= MARK_COUNT:
                yield (
                    f"{kind} {name!r} is {levels[mark]:g} in {counts[mark]} of {len(values)} rows and within"
                    f" {others[0]:.3g} to {others[-1]:.3g} in all others: a mark of missing values? "
                    + ("make it NaN" if kind == "action" else "fill it, or leave these frames out")
                )


def scale_warnings(
    trajectories: Sequence[np.ndarray], called: Sequence[str], names: Sequence[str], kind: str
) -> Iterator[str]:
    """Finds trajectories in which a column reaches twenty times as far as in three quarters of the others.

    If most columns of a trajectory reach twenty times as far as in half of the others, all are compared with that half.
    Also finds those in which most columns move, but less than a twentieth as far as in half of the others.
    """
    known = [(name, rows) for name, rows in zip(called, trajectories, strict=True) if len(rows)]
    if len(known) < 3:
        return
    middle = np.median(np.concatenate([rows for _, rows in known]), axis=0)
    reach = np.stack([np.abs(rows - middle).max(0) for _, rows in known])
    half, usual = (np.sort(reach, axis=0)[quarters * (len(known) - 1) // 4] for quarters in (2, 3))
    far = (reach > OTHER * half) & (half > 0)
    usual = half if (2 * far.sum(1) > (half > 0).sum()).any() else usual
    odd = (reach > OTHER * usual) & (usual > 0)
    if odd.any():
        said = [
            f"{names[column]!r} {reach[odd[:, column], column].min() / usual[column]:.3g} times"
            for column in np.flatnonzero(odd.any(0))
        ]
        where = some([known[index][0] for index in np.flatnonzero(odd.any(1))])
        yield (
            f"{kind}s reach farther than usual, {some(said)}, in {where}: another unit, or a measurement that failed?"
        )
    moved = np.stack([np.ptp(rows, axis=0) for _, rows in known])
    usual = np.median(moved, axis=0)
    few = (moved > 0) & (OTHER * moved < usual)
    little = np.flatnonzero(2 * few.sum(1) > (usual > 0).sum())
    if len(little):
        where = some([known[index][0] for index in little])
        yield (
            f"most {kind}s move less than a twentieth as far as usual in {where}: another unit, or sensors that saw"
            " nothing?"
        )


def spike_warnings(actions: Sequence[np.ndarray], called: Sequence[str], names: Sequence[str]) -> Iterator[str]:
    """Finds labels in actions ``[T_i, a]``, NaN where unlabelled, that leap for one frame."""
    labels = [steps[np.isfinite(steps).all(-1)] for steps in actions]
    known = [each for *each, own in zip(called, actions, labels, strict=True) if len(own) > 2]
    if not known:
        return
    bound, _ = leap_bounds([own for own in labels if len(own) > 2])
    for column, name in enumerate(names):
        found = []
        for source, steps in known:
            change = np.diff(steps[:, column])
            out = (np.abs(change) > bound[column])[:-1] & (np.abs(change) > bound[column])[1:]
            at = np.flatnonzero(out & (change[:-1] * change[1:] < 0)) + 1
            found += [f"{steps[step, column]:.3g} in label {step} of {source}" for step in at]
        if found:
            yield (
                f"action {name!r} is {found[0]}{_more(found)} and far from that in the labels before and after: a"
                " difference of wrapped angles, or a command that was not logged? correct it, or make it NaN"
            )


def unlabelled_warnings(
    trajectories: Sequence[np.ndarray], known: Sequence[bool], called: Sequence[str], names: Sequence[str]
) -> Iterator[str]:
    """Finds columns of ``[T_i, d]`` in which over 10 % of the unlabelled trajectories differ from the labelled ones.

    They differ if most frames lie outside the labelled range, widened by half of it on both sides. They also differ if
    two or more columns that move in all labelled trajectories move less than a tenth as far; a column and its speed
    count as one. ``known`` says which trajectories have labels.
    """
    labelled, others = (
        [frames for frames, one in zip(trajectories, known, strict=True) if one == has] for has in (True, False)
    )
    if len(labelled) < 3 or not others:
        return
    low, high = (end(np.concatenate(labelled), axis=0) for end in (np.min, np.max))
    room = (high - low) / 2
    out = np.stack([((frames < low - room) | (frames > high + room)).mean(0) > 0.5 for frames in others])
    out &= room > 0
    with_labels, without = (np.stack([np.ptp(frames, axis=0) for frames in part]) for part in (labelled, others))
    least = np.median(with_labels, axis=0) / LESS
    rests = (without < least) & (with_labels > least).all(0)
    rests &= (rests & ~_speeds(labelled)).sum(1, keepdims=True) > 1  # one alone may have its goal near
    unlabelled = [name for name, one in zip(called, known, strict=True) if not one]
    for odd, said, why in (
        (
            out,
            "lie far from all labelled trajectories",
            "another origin or unit, or places that no label shows? use one origin, or label some",
        ),
        (
            rests,
            "move less than a tenth as far as in labelled trajectories",
            "another unit, or sensors that were off? convert to one unit, or leave out these recordings, not columns",
        ),
    ):
        found = np.flatnonzero(odd.mean(0) > AFAR)
        if len(found):
            where = [unlabelled[index] for index in np.flatnonzero(odd[:, found].any(1))]
            yield (
                f"columns {some([repr(names[column]) for column in found])} {said} in {len(where)} of {len(others)}"
                f" without labels ({some(where)}): {why}"
            )


def _speeds(trajectories: Sequence[np.ndarray]) -> np.ndarray:
    """Returns which columns of ``[T_i, d]`` are the speed of another one, bool ``[d]``."""
    changes = np.concatenate([np.diff(frames, axis=0) for frames in trajectories])
    middles = np.concatenate([(frames[1:] + frames[:-1]) / 2 for frames in trajectories])
    scaled = [(part - part.mean(0)) / np.maximum(part.std(0), np.finfo(float).tiny) for part in (changes, middles)]
    alike = np.abs(scaled[0].T @ scaled[1]) > SPEED * len(changes)
    return (alike & ~np.eye(len(alike), dtype=bool)).any(0)
