# This source code is licensed under the MIT license found in the LICENSE file.
"""How far the actions of a policy of its own lie from recorded ones; it makes no plan and decodes no state."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data import cut_windows
from torchrl_koap.evaluation.label_errors import summarise_errors
from torchrl_koap.evaluation.plan_errors import SAMPLES, sample_sequences, score_sequences
from torchrl_koap.modules import DiffusionPolicy, LinearActionDecoder
from torchrl_koap.tasks import Task
from torchrl_koap.training.action_errors import episodes_outside


def errors_of_chunks(
    policy: DiffusionPolicy,
    data: TensorDictBase,
    labelled: TensorDictBase,
    task: Task,
    *,
    samples: int = SAMPLES,
    chunks: int = 500,
    seed: int = 0,
) -> dict[str, Any]:
    """Errors on the trajectories that have labels of which none was in the budget; an analysis, nothing selects by it.

    Args:
        policy (DiffusionPolicy): the trained policy.
        data (TensorDictBase): flat data ``[N]`` with ``state`` and all labels that there are.
        labelled (TensorDictBase): the same after the budget was applied.
        task (Task): names and units of the actions.

    Keyword Args:
        samples (int): chunks per situation.
        chunks (int): situations at most, spread evenly over all labelled steps.
        seed (int): seed of the chunks' noise.

    Returns:
        dict: of :func:`~torchrl_koap.evaluation.label_errors.summarise_errors` for the mean of the sampled first
        actions, where ``"ridge"`` is a linear policy of the same frames; and ``chunk``: a row per unit with energy
        score and best of all sampled chunks (:func:`~torchrl_koap.evaluation.plan_errors.score_sequences`), where every
        step of them has a label. Or a ``note`` why there is none.
    """
    history, targets = policy.history, list(task.targets)
    episodes = episodes_outside(data, labelled)
    keys = ["state", "action", "has_action", "episode"]
    windows = cut_windows(data, history - 1 + policy.horizon, select=keys, pad_before=history - 1).cpu()
    now = history - 1
    windows = windows[windows["has_action"][:, now, 0]]
    known = cut_windows(labelled, history + 1, select=keys, pad_before=history - 1).cpu()
    known = known[known["has_action"][:, now, 0]]
    windows = windows[torch.isin(windows["episode"][:, -1], episodes.cpu())]
    if not len(windows):
        return {"note": "no trajectory outside the budget has labels"}
    if len(windows) > chunks:
        windows = windows[torch.linspace(0, len(windows) - 1, chunks).round().long()]

    def moved(part: TensorDictBase) -> Tensor:
        """Absolute actions as distances from where their columns are in the present frame."""
        action = part["action"][:, now:]
        return action - part["state"][:, now : now + 1, targets] if targets else action

    past, true = windows["state"][:, :history].float(), moved(windows)
    device = next(iter(policy.state_dict().values())).device
    sampled = sample_sequences(policy.sample, policy.noise_shape, past.to(device), samples=samples, seed=seed).cpu()
    sampled = sampled - past[:, now : now + 1, targets] if targets else sampled
    seen = moved(known)[:, 0]
    mean = seen.mean(0)
    models = {
        "controller": sampled[:, :, 0].mean(0),
        "ridge": _linear_policy(policy, known, seen, past),
        "mean_action": mean.expand(len(true), -1),
    }
    errors = summarise_errors(models, true[:, 0], windows["episode"][:, -1], task)
    whole = windows["has_action"][:, now:].all(1).squeeze(-1)
    if not whole.any():
        return errors
    sequences = {"policy": sampled[:, whole], "mean_action": mean.expand_as(true[whole])[None]}
    rows, _ = score_sequences(sequences, true[whole], task.action_names, list(task.action_units))
    return errors | {"chunk": {"situations": int(whole.sum()), "samples": samples, "unit": rows}}


def _linear_policy(policy: DiffusionPolicy, known: TensorDictBase, action: Tensor, past: Tensor) -> Tensor:
    """Actions ``[N, act]`` of a ridge regression on what the policy is conditioned on."""
    device = next(iter(policy.state_dict().values())).device
    condition, asked = (
        policy.encode_history(frames.float().to(device)).cpu() for frames in (known["state"][:, : policy.history], past)
    )
    ridge = LinearActionDecoder(condition.shape[-1], action.shape[-1]).to(condition.dtype)
    every = torch.ones(len(condition), dtype=torch.bool)
    ridge.fit_ridge(condition, action, every, groups=known["episode"][:, -1], default_penalty=0.15)
    return ridge.linear(asked).detach()
