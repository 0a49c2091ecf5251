# This source code is licensed under the MIT license found in the LICENSE file.
"""Quantities of a demonstration of Avoiding by which human and scripted ones are compared.

Commands are changes of the commanded xy per control step (mm).
"""

import numpy as np

from torchrl_koap.envs.experts.avoiding import AvoidingExpert
from torchrl_koap.tasks.avoiding import FINISH_Y

MOVING = 3.0  # mm per step
LOOK_AHEAD = 8


def statistics(episode: np.ndarray) -> dict[str, float]:
    """Quantities of one demonstration ``[T, 4]``, by name."""
    command, measured = episode[:, :2], episode[:, 2:]
    steps = np.diff(command, axis=0) * 1e3
    speed = np.linalg.norm(steps, axis=1)
    size = np.abs(steps)
    moving = speed > MOVING
    begin = int(np.argmax(moving))
    end = int(np.argmax(measured[:, 1] > FINISH_Y))
    run = slice(begin, end)
    jerk = np.abs(np.diff(steps, axis=0))
    lag = np.linalg.norm(command - measured, axis=1) * 1e3
    values = {
        "rows": len(command),
        "rows before the first movement": begin,
        "rows after the finish line": len(command) - end,
        "length of the measured path (m)": np.linalg.norm(np.diff(measured, axis=0), axis=1).sum(),
        "last measured y (m)": measured[-1, 1],
        "least clearance (mm)": 1e3 * AvoidingExpert.clearance(episode),
        "speed, mean while moving (mm/step)": speed[run].mean(),
        "speed, variation (std / mean)": speed[run].std() / speed[run].mean(),
        "command to measured, median (mm)": np.median(lag),
        "wobble of the measured path, rms (mm)": wobble(measured[run]),
        "wobble of the command, rms (mm)": wobble(command[run]),
        "sideways pushes": pushes(steps[:, 0]),
        "slow-downs": int(
            ((size[1:-1, 1] < size[:-2, 1]) & (size[1:-1, 1] <= size[2:, 1]) & (size[1:-1, 1] < 8))[run].sum()
        ),
    }
    for axis, name in enumerate("xy"):
        values |= {
            f"{name} step, 95th percentile (mm)": np.percentile(size[:, axis], 95),
            f"{name} idle (< 1 mm), share (%)": 100 * (size[:, axis] < 1).mean(),
            f"{name} in between (1 to 5 mm), share (%)": 100 * ((size[:, axis] >= 1) & (size[:, axis] < 5)).mean(),
            f"{name} partial (5 to 11.5 mm), share (%)": 100 * ((size[:, axis] >= 5) & (size[:, axis] < 11.5)).mean(),
            f"{name} full (11.5 mm and more), share (%)": 100 * (size[:, axis] >= 11.5).mean(),
            f"{name} change of step, mean (mm)": jerk[:, axis].mean(),
            f"{name} change of step, 95th percentile (mm)": np.percentile(jerk[:, axis], 95),
            f"{name} autocorrelation of steps, lag 1": autocorrelation(steps[run, axis], 1),
            f"{name} autocorrelation of steps, lag 5": autocorrelation(steps[run, axis], 5),
            f"{name} autocorrelation of steps, lag 10": autocorrelation(steps[run, axis], 10),
        }
    return values


def wobble(path: np.ndarray, width: float = 4.0) -> float:
    """Rms distance (mm) across the direction of travel between a path and itself smoothed over ``width`` steps."""
    reach = int(3 * width)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    weights /= weights.sum()
    smooth = np.stack([np.convolve(path[:, axis], weights, mode="valid") for axis in (0, 1)], axis=1)
    travel = np.gradient(smooth, axis=0)
    normal = np.stack([-travel[:, 1], travel[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return 1e3 * np.sqrt((((path[reach:-reach] - smooth) * normal).sum(1) ** 2).mean())


def pushes(steps: np.ndarray, threshold: float = 4.0) -> int:
    """Number of separate sideways pushes."""
    direction = np.where(np.abs(steps) > threshold, np.sign(steps), 0)
    return int(((direction[1:] != direction[:-1]) & (direction[1:] != 0)).sum())


def autocorrelation(values: np.ndarray, lag: int) -> float:
    """Correlation of a series with itself ``lag`` steps later."""
    centred = values - values.mean()
    return float((centred[lag:] * centred[:-lag]).sum() / max((centred**2).sum(), 1e-12))


def ridge_error(episodes: list[np.ndarray], strength: float = 1e-6) -> float:
    """Error (mm, rms) of a linear guess of the command from measured positions before, now and ahead, per axis.

    Fitted on all demonstrations but one and tested on that one; a measure of how abrupt the commands are.
    """
    features, targets = [], []
    for episode in episodes:
        command, measured = episode[:, :2], episode[:, 2:]
        now = np.arange(1, len(command) - 1)
        ahead = np.minimum(now + LOOK_AHEAD, len(measured) - 1)
        seen = np.concatenate([measured[now - 1], measured[now], measured[ahead], np.ones((len(now), 1))], axis=1)
        features.append(seen)
        targets.append(np.diff(command, axis=0)[now])
    products = [x.T @ x for x in features]
    moments = [x.T @ y for x, y in zip(features, targets, strict=True)]
    errors = []
    for index, (x, y) in enumerate(zip(features, targets, strict=True)):
        gram = sum(products) - products[index] + strength * np.eye(x.shape[1])
        errors.append(((x @ np.linalg.solve(gram, sum(moments) - moments[index]) - y) ** 2).ravel())
    return 1e3 * float(np.sqrt(np.concatenate(errors).mean()))
