# This source code is licensed under the MIT license found in the LICENSE file.
"""Fits a controller's decoder in closed form on all labelled steps of a data set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_koap.data.trajectories import labelled_episodes
from torchrl_koap.data.windows import cut_windows
from torchrl_koap.keys import ACTION, EPISODE, STATE
from torchrl_koap.modules import InverseDynamics
from torchrl_koap.tasks import Task

MOST = 50_000  # labelled steps at most: random features of this many take a gigabyte


class UnusableLabelsError(ValueError):
    """All labels lie so near the ends of their trajectories that no controller can be fitted to them."""


def fit_closed_form(controller: InverseDynamics, data: TensorDictBase, **known: Any) -> dict[str, Any]:
    """Fits a controller's decoder on every labelled step whose whole look-ahead was recorded; each is used once.

    At most 50,000 steps are used, spread evenly. The data are flat ``[N]``, after the label budget was applied;
    ``known`` are the facts of :func:`action_facts`. Returns the result of
    :meth:`~torchrl_koap.modules.InverseDynamics.fit_labels`. Raises an UnusableLabelsError if there is no such step.
    """
    data = data[torch.isin(data[EPISODE], labelled_episodes(data))]
    now, entries = controller.num_past, {controller.in_key: STATE, controller.out_key: ACTION, EPISODE: EPISODE}
    select = list(entries.values())
    cut = cut_windows(data, controller.num_window_frames, select=select, pad_before=now, labelled_frame=now, most=MOST)
    if not len(cut):
        raise UnusableLabelsError(f"no label is followed by {controller.num_window_frames - 1 - now} recorded steps")
    windows = TensorDict({own: cut[name] for own, name in entries.items()}, cut.shape)
    mask = torch.zeros_like(cut[EPISODE], dtype=torch.bool)
    mask[:, now] = True  # other frames would use a step twice, with a clamped look-ahead
    return controller.fit_labels(windows, mask, **known)


def action_facts(task: Task, columns: Sequence[int]) -> dict[str, Any]:
    """Finds which of the state columns that the controller reads each action moves.

    ``axes`` is empty if this is unknown. For a task without an environment it may be ``guessed``. Actions are
    ``alike`` unless all are raw.
    """
    axes = list(task.moved_columns())
    guessed = not axes
    if guessed:
        moved = tuple(task.targets.values()) or (task.robot if task.delta_actions else ())
        if task.env is None and len(moved) == task.action_dim and set(moved) <= set(columns):
            axes = [list(columns).index(column) for column in moved]
    alike = any(action.kind != "raw" for action in task.actions.values())
    return {"axes": axes, "guessed": guessed, "alike": alike}
