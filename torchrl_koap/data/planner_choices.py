# This source code is licensed under the MIT license found in the LICENSE file.
"""Chooses how many frames a planner of recorded data observes, and how many updates train it."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.data.windows import cut_windows, spread_evenly
from torchrl_koap.keys import EPISODE, STATE
from torchrl_koap.tasks import HISTORY, WINDOW, Task

ENOUGH = 2.0  # the last change is observed if it lowers the error of predictions by more than this factor
WEIGHTS = (0.5, 1.0, 2.0, 4.0)  # of the last change in distances; the best one counts
NEIGHBORS, WINDOWS, ASKED = 5, 20_000, 2_000  # windows at most, and predictions
PER_UPDATE = 8  # recorded steps; an update reads 512 windows, so all are read 64 times
LEAST_UPDATES, MOST_UPDATES = 3000, 12_000


def planner_updates(steps: int) -> tuple[int, str]:
    """Chooses the most updates, in thousands, for a planner of recordings with ``steps`` in all; and says why."""
    updates = min(max(round(steps // PER_UPDATE, -3), LEAST_UPDATES), MOST_UPDATES)
    why = f"one for {PER_UPDATE} recorded steps, from {LEAST_UPDATES:,} to {MOST_UPDATES:,}"
    return updates, f"at most {updates:,} updates: {why}"


def observed_frames(data: TensorDictBase, task: Task) -> tuple[int, str]:
    """Chooses the frames that a planner of flat data ``[N]`` with ``state`` observes; returns their number and why.

    Two where the motion so far tells much about the future: where several routes leave one place, or momentum counts.
    Otherwise one: planners copy velocities that they see, whatever the scene shows.
    """
    lengths = trajectory_lengths(data)
    fits = lengths >= WINDOW
    if fits.sum() < 2:
        return HISTORY, f"{HISTORY} frames: fewer than two trajectories have the {WINDOW} steps of a window"
    gain = motion_gain(data[fits.repeat_interleave(lengths)], task)
    frames = HISTORY if gain > ENOUGH else 1
    why = f"knowing the last change divides the error of predictions by {gain:.2f} ({HISTORY} frames above {ENOUGH:g})"
    return frames, f"{frames} frame{'s' * (frames > 1)}: {why}"


def motion_gain(data: TensorDictBase, task: Task) -> float:
    """Returns the factor by which the last change of the state lowers the squared error of predictions.

    The mean of the nearest windows of other trajectories predicts the displacements of the robot's columns in the next
    frames. Nearness is that of present frames alone, or with their last changes. Columns and displacements are divided
    by their standard deviations. Flat data ``[N]`` hold two or more trajectories, each as long as a window.
    """
    windows = cut_windows(data, WINDOW, select=[STATE, EPISODE], most=WINDOWS)
    states, episode = windows[STATE].float(), windows[EPISODE][:, 0]
    past, present, future = states[:, 0], states[:, 1], states[:, HISTORY:]
    ahead = future - present[:, None]
    if task.robot:
        ahead = ahead[..., list(task.robot)]
    ahead = _scaled(ahead.flatten(0, 1)).view(len(states), -1)
    asked = spread_evenly(torch.arange(len(states), device=states.device), ASKED)
    place, change = (torch.cdist(part[asked], part).square() for part in map(_scaled, (present, present - past)))
    own = episode[asked, None] == episode
    place.masked_fill_(own, torch.inf)
    neighbors = min(NEIGHBORS, int((~own).sum(1).min()))

    def error(weight: float) -> float:
        nearest = (place + weight**2 * change).topk(neighbors, largest=False).indices
        return float((ahead[nearest].mean(1) - ahead[asked]).square().mean())

    blind, seeing = error(0.0), min(map(error, WEIGHTS))
    return blind / seeing if seeing else torch.inf if blind else 1.0


def _scaled(rows: Tensor) -> Tensor:
    """Divides the columns of ``[N, d]`` by their standard deviations; constant ones become 0."""
    spread = rows.std(0)
    return torch.where(spread > 0, (rows - rows.mean(0)) / spread, 0.0)
