# This source code is licensed under the MIT license found in the LICENSE file.
"""How far plans lie from what was recorded, on trajectories that the planner has not seen; no environment needed.

A planner says what may come next, and more than one thing may. A single sample is then a bad measure: one that follows
another way than the demonstrator is no mistake. Scores of the whole distribution are not fooled by that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data import cut_windows
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.modules import StatePlanner
from torchrl_koap.modules.planning.energy_score import energy_score, sample_sequences
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
    rows, scores = _score(models, future, task.state_names, task.state_units)
    return {
        "situations": len(past),
        "horizon": horizon,
        "samples": samples,
        "relative": _relative(scores, "planner"),
        "unit": rows,
        "trajectory": [
            {"episode": number, "relative_plan_error": _relative(scores, "planner", episode == number)}
            for number in episode.unique().tolist()
        ],
    }


def _score(
    models: Mapping[str, Tensor], true: Tensor, names: Sequence[str], units: Sequence[str]
) -> tuple[list[dict[str, Any]], list[dict[str, Tensor]]]:
    """Rates plans ``[S, N, H, d]`` by energy score and best sample, and every model in every situation ``[N]``."""
    rows, scores = [], []
    for unit, columns in unit_groups(units).items():
        row: dict[str, Any] = {"unit": unit, "columns": [names[column] for column in columns]}
        per_situation = {}
        for name, sampled in models.items():
            score = energy_score(sampled[..., columns], true[..., columns])  # [N, H]
            distance = (sampled - true)[..., columns].norm(dim=-1)  # [S, N, H]
            row[name] = {
                "energy_score": _over_steps(score.mean().item(), score.mean(0)),
                "best_of": _over_steps(distance.mean(-1).amin(0).mean().item(), distance.amin(0).mean(0)),
            }
            per_situation[name] = score.mean(-1)
        rows.append(row)
        scores.append(per_situation)
    return rows, scores


def _over_steps(overall: float, per_step: Tensor) -> dict[str, Any]:
    return {"overall": overall, "per_step": per_step.tolist()}


def _relative(scores: list[dict[str, Tensor]], name: str, where: Tensor | None = None) -> float | None:
    """Score over that of standing still, the mean over units; units in which nothing moves are left out."""
    shares = []
    for row in scores:
        own, still = (row[key] if where is None else row[key][where] for key in (name, "standing_still"))
        if still.mean() > 0:
            shares.append((own.mean() / still.mean()).item())
    return sum(shares) / len(shares) if shares else None
