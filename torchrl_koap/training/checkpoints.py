# This source code is licensed under the MIT license found in the LICENSE file.
"""Training states from which a run goes on bit for bit: parameters, optimiser, random numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_koap.runs.weights import CheckpointError, load_tensors, save_tensors

_MOMENTS = {"step", "exp_avg", "exp_avg_sq"}  # what AdamW keeps of a parameter


def save_training_state(
    path: str | Path, module: nn.Module, optimizer: torch.optim.Optimizer, about: Mapping[str, Any]
) -> None:
    """Writes everything a training loop needs to go on: parameters (targets included), moments, random state, facts.

    The module holds the loss, and what else has a state. Facts are such as ``{"phase": "planner", "step": 500}``.
    """
    state = optimizer.state_dict()
    tensors = {name: value for name, value in module.state_dict().items() if isinstance(value, Tensor)}
    for index, moments in state["state"].items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
    tensors["rng.cpu"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors |= {f"rng.cuda.{i}": value for i, value in enumerate(torch.cuda.get_rng_state_all())}
    groups = [{**group, "lr": float(group["lr"])} for group in state["param_groups"]]  # a tensor where it is replayed
    save_tensors(path, tensors, {**about, "param_groups": groups, "moments": len(state["state"])})


def load_training_state(path: str | Path, module: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Restores what :func:`save_training_state` wrote, the global random state included, and returns the facts.

    Raises:
        CheckpointError: if the file is damaged, no training state, lacks that of the optimiser, or does not fit the
            module or the optimiser. Nothing has been changed then.
    """
    tensors, about = load_tensors(path)
    if "rng.cpu" not in tensors or "param_groups" not in about:
        raise CheckpointError(f"{path} is no state of a training")
    if type(about.get("step")) is not int or about["step"] < 0:
        raise CheckpointError(
            f"{path} is damaged: its step must be a whole number from 0 on, got {about.get('step')!r}"
        )
    wanted = {name: value for name, value in module.state_dict().items() if isinstance(value, Tensor)}
    saved = {name: value for name, value in tensors.items() if not name.startswith(("optimizer.", "rng."))}
    if wanted.keys() != saved.keys() or any(wanted[name].shape != saved[name].shape for name in wanted):
        raise CheckpointError(f"{path} holds the state of another model")
    for name, value in saved.items():
        if value.dtype != wanted[name].dtype:
            raise CheckpointError(f"{path} is damaged: {name} is {value.dtype}, wanted {wanted[name].dtype}")
    groups = _param_groups(path, about.pop("param_groups"), optimizer)
    moments = _moments(path, tensors, optimizer)
    if about.pop("moments", len(moments)) != len(moments) or (about["step"] > 0 and not moments):
        raise CheckpointError(f"{path} lacks the state of the optimiser: {len(moments)} parameters have moments")
    _check_random_state(path, tensors["rng.cpu"])
    with torch.no_grad():
        for name, value in wanted.items():
            value.copy_(saved[name])
    optimizer.load_state_dict({"state": moments, "param_groups": groups})
    torch.set_rng_state(tensors["rng.cpu"])
    cuda = [tensors[name] for name in sorted(tensors) if name.startswith("rng.cuda.")]
    if cuda and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(cuda)
    return about


def _param_groups(path: str | Path, saved: Any, optimizer: torch.optim.Optimizer) -> list[dict[str, Any]]:
    """The optimiser's settings, which are those of the run; only the learning rate has gone on since."""
    now = optimizer.state_dict()["param_groups"]
    if not isinstance(saved, list) or len(saved) != len(now) or not all(isinstance(group, dict) for group in saved):
        raise CheckpointError(f"{path} is damaged: param_groups must be a list of {len(now)} objects")
    for old, new in zip(saved, json.loads(json.dumps(now, default=float)), strict=True):
        rate = old.get("lr")
        if type(rate) not in (int, float) or not math.isfinite(rate) or rate < 0:
            raise CheckpointError(f"{path} is damaged: param_groups: lr must be a number from 0 on, got {rate!r}")
        other = [key for key in new if key != "lr" and key in old and old[key] != new[key]]
        if other or "params" not in old:
            raise CheckpointError(f"{path} is of another optimiser: {', '.join(other) or 'params'} differ")
    return saved


def _moments(
    path: str | Path, tensors: Mapping[str, Tensor], optimizer: torch.optim.Optimizer
) -> dict[int, dict[str, Tensor]]:
    """The optimiser's state by number of the parameter."""
    shapes = [parameter.shape for group in optimizer.param_groups for parameter in group["params"]]
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if not name.startswith("optimizer."):
            continue
        _, index, key = (*name.split("."), "", "")[:3]
        fits = index.isdecimal() and int(index) < len(shapes) and name.count(".") == 2
        if not fits or (key != "step" and value.shape != shapes[int(index)]) or not value.isfinite().all():
            raise CheckpointError(f"{path} is damaged: {name} does not belong to any parameter, or is not finite")
        moments.setdefault(int(index), {})[key] = value
    lacking = [index for index, entries in moments.items() if entries.keys() != _MOMENTS]
    if lacking:
        raise CheckpointError(f"{path} is damaged: parameter {lacking[0]} lacks part of the state of its optimiser")
    return moments


def _check_random_state(path: str | Path, state: Tensor) -> None:
    try:
        torch.Generator().set_state(state)
    except (RuntimeError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged: rng.cpu is no random state: {error}") from error
