# This source code is licensed under the MIT license found in the LICENSE file.
"""Checkpoints from which a training resumes bit for bit: parameters, optimiser, random numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_koap.runs.weights import CheckpointError, load_tensors, save_tensors


def save_training_state(
    path: str | Path, module: nn.Module, optimizer: torch.optim.AdamW, about: Mapping[str, Any]
) -> None:
    """Writes all that a training loop needs to resume: parameters (targets included), moments, random state, ``about``.

    The module holds the loss and all else that has a state. ``about`` is, e.g., ``{"phase": "planner", "step": 500}``.
    """
    moments = optimizer.state_dict()["state"]
    tensors = _state(module)
    for index, held in moments.items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in held.items()}
    save_tensors(path, tensors, {**about, "moments": [str(index) for index in moments]})


def load_training_state(path: str | Path, module: nn.Module, optimizer: torch.optim.AdamW) -> dict[str, Any]:
    """Restores what :func:`save_training_state` wrote, with the global random state; returns ``about``.

    Raises:
        CheckpointError: if the file is damaged, is not a training state, or does not fit the module or the optimiser;
            nothing is changed then. Its checksum vouches for the values.
    """
    tensors, about = load_tensors(path)
    known = about.pop("moments", None)
    if known is None:
        raise CheckpointError(f"{path} is not a training state")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = {
        index: {"step": torch.tensor(0.0), "exp_avg": parameter, "exp_avg_sq": parameter}
        for index, parameter in enumerate(parameters)
        if str(index) in known
    }
    wanted = _state(module)
    wanted |= {f"optimizer.{index}.{name}": like for index, held in moments.items() for name, like in held.items()}
    if wanted.keys() != tensors.keys() or any(
        (like.shape, like.dtype) != (tensors[name].shape, tensors[name].dtype) for name, like in wanted.items()
    ):
        raise CheckpointError(f"{path} holds the state of another model")
    with torch.no_grad():
        for name, value in _state(module).items():
            value.copy_(tensors[name])
    state = {index: {name: tensors[f"optimizer.{index}.{name}"] for name in held} for index, held in moments.items()}
    # hyperparameters come from the run's options; the loop sets the learning rate at every update
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    torch.set_rng_state(tensors["rng.cpu"])
    if "rng.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["rng.cuda"], next(module.parameters()).device)
    return about


def _state(module: nn.Module) -> dict[str, Tensor]:
    """Returns the tensors of a module, and the random states of the CPU and of the module's GPU, if it is on one."""
    own = {name: value for name, value in module.state_dict().items() if isinstance(value, Tensor)}
    device = next(module.parameters()).device
    cuda = {"rng.cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {}
    return own | {"rng.cpu": torch.get_rng_state()} | cuda
