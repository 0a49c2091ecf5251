# This source code is licensed under the MIT license found in the LICENSE file.
"""Labels that are logged after the motion that they cause."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.tasks import Task

REACH = 3  # frames before and after a label; a longer lag is not found
CLEAR, NEAR = 0.15, 0.05  # shares of the error without labels: least gain by late labels; gains that are ignored
FOLDS, MOST, PENALTY = 5, 4000, 1e-9  # of the cross-validation; most rows; relative ridge
INNOVATION = 3e-4  # share of the changes' variance that past states must leave unexplained; analytic paths leave less
LARGEST_GAIN = 1.03  # largest coefficient of a target: a robot goes no farther than its target


def late_warnings(data: TensorDictBase, task: Task) -> Iterator[str]:
    """Yields a warning if labels of flat data ``[N]`` are late: later labels explain the motion, present ones less."""
    late = frames_late(data, task)
    if late:
        frames = "one frame" if late == 1 else f"{late} frames"
        yield (
            f"actions look {frames} late: the robot moves {frames} before its command, and policies trained on such"
            f" labels fail; shift the actions of every recording {frames} earlier and leave the last ones empty, unless"
            " a script computed them from noisy states"
        )


def frames_late(data: TensorDictBase, task: Task) -> int:
    """Counts the frames by which the labels of flat data ``[N]`` are late; 0 where that is not clear.

    This is a test of Granger causality. Cross-validated ridge regression predicts the next change of every commanded
    column from past states and labels up to some frame. If labels are on time, those up to the present frame suffice,
    or present state and label alone. If later ones are needed, labels are late by that many frames. Labels of a script
    that reacts to noisy states look the same, but their coefficient is negative, or above 1 for targets; they count as
    on time. So do labels at another rate than the commands: a later label tells of commands between two frames, but
    weighs less than the present one.

    Early labels look like a robot that responds late. A robot that responds k frames late hides k late frames.
    """
    rows = _labelled_rows(data)
    states = task.state_of(data.get(keys.OBSERVATION).double()).cpu().numpy()
    actions, moved = data.get(keys.ACTION).double().cpu().numpy(), list(task.moves.values())
    change = (states[rows + 1] - states[rows])[:, moved]
    robot = states[:, list(task.robot) or moved]
    inputs = (REACH + 1) * robot.shape[1] + (2 * REACH + 1) * actions.shape[1]
    if not moved or len(rows) <= inputs:
        return 0
    past = [robot[rows]] + [robot[rows - i] - robot[rows - i - 1] for i in range(REACH)]
    errors, simple = _regress(past, change)[0], _regress([robot[rows], actions[rows]], change)[0]
    used = np.flatnonzero(errors > INNOVATION * change.var(0) * len(rows))
    if not len(used):
        return 0
    change, commands = change[:, used], np.array(list(task.moves))[used]
    errors, simple = errors[used], simple[used]
    given = [actions[rows + ahead] for ahead in range(-REACH, REACH + 1)]
    shares, gains, own = [], [], np.arange(len(used))
    for ahead in range(REACH + 1):
        error, weights = _regress([*past, *given[: REACH + ahead + 1]], change)
        error = error if ahead else np.minimum(error, simple)  # fewer inputs extrapolate better to other recordings
        shares.append(np.median(np.minimum(error / errors, 1)))
        present, last = (weights[-1 - (1 + back) * actions.shape[1] :][commands, own] for back in (ahead, 0))
        gains.append((np.median(present), np.median(last)))
    needed = next(ahead for ahead, share in enumerate(shares) if share <= min(shares) + NEAR)
    largest = LARGEST_GAIN if task.targets else np.inf
    present, last = gains[needed]
    return needed if shares[0] - min(shares) > CLEAR and max(0, present) < last <= largest else 0


def _labelled_rows(data: TensorDictBase) -> np.ndarray:
    """Returns rows ``[n]`` of flat data whose neighbours up to ``REACH`` are labelled and of the same trajectory."""
    episode, labelled = (data.get(key).flatten().cpu().numpy() for key in (keys.EPISODE, keys.HAS_ACTION))
    rows = np.arange(REACH, len(episode) - REACH)
    near = [(episode[rows + ahead] == episode[rows]) & labelled[rows + ahead] for ahead in range(-REACH, REACH + 1)]
    return spread_evenly(torch.from_numpy(rows[np.all(near, axis=0)]), MOST).numpy()


def _regress(parts: list[np.ndarray], outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns cross-validated squared errors ``[d]`` and weights ``[i + 1, d]`` of ridge regression, constant last."""
    inputs = np.concatenate(parts, 1)
    mean, spread = inputs.mean(0), np.maximum(inputs.std(0), 1e-12)
    inputs = np.c_[(inputs - mean) / spread, np.ones(len(inputs))]
    product, sums = inputs.T @ inputs + PENALTY * len(inputs) * np.eye(inputs.shape[1]), inputs.T @ outputs
    error = np.zeros(outputs.shape[1])
    for fold in np.array_split(np.arange(len(inputs)), FOLDS):
        out = inputs[fold]
        weights = np.linalg.solve(product - out.T @ out, sums - out.T @ outputs[fold])
        error += ((outputs[fold] - out @ weights) ** 2).sum(0)
    return error, np.linalg.solve(product, sums) / np.r_[spread, 1.0][:, None]
