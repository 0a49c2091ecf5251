# This source code is licensed under the MIT license found in the LICENSE file.
"""Weights as safetensors with a JSON header, and training states from which a run goes on bit for bit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from torchrl_koap.files import replacing_file
from torchrl_koap.training.compact_weights import expand


class CheckpointError(ValueError):
    """A file of weights that cannot be used: damaged, of another task, or without its statistics."""


def save_weights(path: str | Path, module: nn.Module, about: Mapping[str, Any]) -> None:
    """Writes the state dict of a module, normaliser statistics included, in one go.

    Args:
        path (str or Path): file to write.
        module (nn.Module): the module.
        about (mapping): JSON-serialisable facts kept in the header; ``task`` is checked by :func:`load_weights`.
    """
    save_tensors(path, module.state_dict(), about)


def load_weights(path: str | Path, module: nn.Module, *, task: str) -> dict[str, Any]:
    """Loads weights into a module of the same architecture.

    Args:
        path (str or Path): the file.
        module (nn.Module): receives the weights.
        task (str): name of the task that they must have been trained on.

    Returns:
        dict: the facts in the header.

    Raises:
        CheckpointError: if the file is missing or damaged, belongs to another task, lacks entries (a normaliser's
            statistics, say) or has entries of other shapes.
    """
    tensors, about = load_tensors(path)
    if about.get("task") != task:
        raise CheckpointError(f"{path} was trained on task {about.get('task')!r}, not on {task!r}")
    try:
        module.load_state_dict(expand(tensors))
    except RuntimeError as error:
        problems = " ".join(str(error).split("\n", 1)[-1].split())
        raise CheckpointError(f"{path} does not fit the model: {problems}") from error
    return about


def save_tensors(path: str | Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any] | None = None) -> None:
    """Writes tensors and facts to one safetensors file, aside and renamed.

    Args:
        path (str or Path): the file; it is complete or not there.
        tensors (mapping): tensors by name, on any device.
        about (mapping, optional): facts for the header, plain JSON types.
    """
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with replacing_file(path) as aside:
        save_file(tensors, aside, metadata={"about": json.dumps(about or {})})


def load_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Reads what :func:`save_tensors` wrote.

    Raises:
        CheckpointError: if the file is missing or damaged.

    Examples:
        >>> import tempfile, torch
        >>> from torchrl_koap.training.checkpoints import load_tensors, save_tensors
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_tensors(f"{folder}/a.safetensors", {"x": torch.ones(2)}, {"task": "avoiding"})
        ...     load_tensors(f"{folder}/a.safetensors")
        ({'x': tensor([1., 1.])}, {'task': 'avoiding'})
    """
    if not Path(path).is_file():
        raise CheckpointError(f"{path} is missing")
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
        if not isinstance(about, dict):
            raise ValueError(f"its facts are no object but {type(about).__name__}")
        return load_file(path), about
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error


def save_training_state(
    path: str | Path, loss: nn.Module, optimizer: torch.optim.Optimizer, about: Mapping[str, Any]
) -> None:
    """Writes everything a training loop needs to go on: parameters (targets included), optimiser, random state.

    Args:
        path (str or Path): file to write.
        loss (nn.Module): the loss module, which holds the networks.
        optimizer (Optimizer): its moments are kept.
        about (mapping): facts, for example ``{"phase": "planner", "step": 500}``.
    """
    state = optimizer.state_dict()
    tensors = {f"loss.{name}": value for name, value in loss.state_dict().items() if isinstance(value, Tensor)}
    for index, moments in state["state"].items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
    tensors["rng.cpu"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors |= {f"rng.cuda.{i}": value for i, value in enumerate(torch.cuda.get_rng_state_all())}
    save_tensors(path, tensors, {**about, "param_groups": state["param_groups"]})


def load_training_state(path: str | Path, loss: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Restores what :func:`save_training_state` wrote, the global random state included.

    Args:
        path (str or Path): the file.
        loss (nn.Module): loss module, built as it was; receives its parameters and averages.
        optimizer (torch.optim.Optimizer): optimiser of the same parameters; receives its moments.

    Returns:
        dict: the facts given when it was saved.

    Raises:
        CheckpointError: if the file is damaged, no training state, or does not fit the loss module.
    """
    tensors, about = load_tensors(path)
    if "rng.cpu" not in tensors or "param_groups" not in about:
        raise CheckpointError(f"{path} is no state of a training")
    wanted = {name: value for name, value in loss.state_dict().items() if isinstance(value, Tensor)}
    saved = {name.removeprefix("loss."): value for name, value in tensors.items() if name.startswith("loss.")}
    if wanted.keys() != saved.keys() or any(wanted[name].shape != saved[name].shape for name in wanted):
        raise CheckpointError(f"{path} holds the state of another model")
    with torch.no_grad():
        for name, value in wanted.items():
            value.copy_(saved[name])
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            moments.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": moments, "param_groups": about.pop("param_groups")})
    torch.set_rng_state(tensors["rng.cpu"])
    cuda = [tensors[name] for name in sorted(tensors) if name.startswith("rng.cuda.")]
    if cuda and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(cuda)
    return about
