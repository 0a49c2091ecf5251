# This source code is licensed under the MIT license found in the LICENSE file.
"""How far plans lie from what was recorded, on trajectories that the planner has not seen; no environment needed.

A planner says what may come next, and more than one thing may. A single sample is then a bad measure: one that follows
another way than the demonstrator is no mistake. Scores of the whole distribution are not fooled by that.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data import cut_windows
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.modules import StatePlanner
from torchrl_koap.modules.planning.energy_score import energy_score, relative_score, sample_sequences
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.columns import unit_groups

SAMPLES = 16  # plans in each situation
SITUATIONS = 500  # that are looked at, at most


def baseline_plans(history: Tensor, horizon: int) -> dict[str, Tensor]:
    """Makes the plans ``[*B, H, d]`` that a planner has to beat, of two or more observed states ``[*B, h, d]``."""
    now, before = history[..., -1:, :], history[..., -2:-1, :]
    ahead = torch.arange(1, horizon + 1, device=history.device, dtype=history.dtype)[:, None]
    return {
        "standing_still": now.expand(*now.shape[:-2], horizon, -1),
        "constant_velocity": now + ahead * (now - before),
    }


def plan_errors(
    planner: StatePlanner, data: TensorDictBase, task: Task, *, samples: int = SAMPLES, seed: int = 0
) -> dict[str, Any]:
    """Scores a planner on trajectories that it has not seen, beside standing still and constant velocity.

    There are ``samples`` plans in each of at most :data:`SITUATIONS`, spread evenly over all steps that have a whole
    recorded future.

    Returns:
        dict: ``situations``, ``horizon``, ``samples``, ``unit``: a row per unit of the state columns with their names
        (``columns``) and, per model, ``energy_score`` and ``best_of`` as ``overall`` and ``per_step`` in that unit,
        distances over the columns of the unit together; ``relative``: the energy score as a share of that of standing
        still, the mean over units; ``trajectory``: the relative score per trajectory.
    """
    horizon, history = planner.horizon, max(planner.history, 2)  # constant velocity needs two frames
    windows = cut_windows(data, history + horizon, select=["state", "episode"], pad_before=history - 1)
    windows = spread_evenly(windows, SITUATIONS)
    states = windows["state"].float().cpu()
    past, future = planner.split_window(states[:, history - planner.history :])
    episode = windows["episode"][:, -1].cpu()
    device = next(iter(planner.state_dict().values())).device
    models = {"planner": sample_sequences(planner, past.to(device), samples=samples, seed=seed).cpu()}
    models |= {name: plan[None] for name, plan in baseline_plans(states[:, :history], horizon).items()}
    groups = unit_groups(task.state_units)

    def relative(where: Tensor) -> float | None:
        parts = models["planner"][:, where], future[where], models["standing_still"][0, where]
        score = relative_score(*parts, list(groups.values()))
        return None if math.isnan(score) else score

    return {
        "situations": len(past),
        "horizon": horizon,
        "samples": samples,
        "relative": relative(torch.ones_like(episode, dtype=torch.bool)),
        "unit": [
            {"unit": unit, "columns": [task.state_names[column] for column in columns]}
            | {name: _score(sampled[..., columns], future[..., columns]) for name, sampled in models.items()}
            for unit, columns in groups.items()
        ],
        "trajectory": [
            {"episode": number, "relative_plan_error": relative(episode == number)}
            for number in episode.unique().tolist()
        ],
    }


def _score(sampled: Tensor, true: Tensor) -> dict[str, dict[str, Any]]:
    """Rates plans ``[S, N, H, d]`` by energy score and best sample, over all and per step."""
    score = energy_score(sampled, true)  # [N, H]
    distance = (sampled - true).norm(dim=-1)  # [S, N, H]
    return {
        "energy_score": {"overall": score.mean().item(), "per_step": score.mean(0).tolist()},
        "best_of": {
            "overall": distance.mean(-1).amin(0).mean().item(),
            "per_step": distance.amin(0).mean(0).tolist(),
        },
    }
