# This source code is licensed under the MIT license found in the LICENSE file.
"""Weights as safetensors with a JSON header, and training states from which a run goes on bit for bit."""

from __future__ import annotations

import errno
import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from torchrl_koap.files import replacing_file
from torchrl_koap.modules import Normalizer
from torchrl_koap.training.compact_weights import expand

_LENGTH = 64  # digits of a checksum
_SHA256 = "sha256"  # among the facts of a file: the checksum of its tensors and of the other facts


_MOMENTS = {"step", "exp_avg", "exp_avg_sq"}  # what AdamW keeps of a parameter


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
    check_weights(path, module)
    return about


def check_weights(path: str | Path, module: nn.Module) -> None:
    """Refuses weights with which nothing can be computed.

    Args:
        path (str or Path): the file they are from, for the message.
        module (nn.Module): the module that has received them.

    Raises:
        CheckpointError: naming an entry that is NaN or infinite, or a normaliser whose scale is not positive.
    """
    for name, value in module.named_parameters():  # of a buffer that nobody has fitted NaN says just that
        if not value.isfinite().all():
            raise CheckpointError(f"{path} is damaged: {name} is NaN or infinite")
    for name, part in module.named_modules():
        if not isinstance(part, Normalizer) or not part.is_fitted:
            continue
        if not part.offset.isfinite().all() or not part.scale.isfinite().all() or not (part.scale > 0).all():
            raise CheckpointError(
                f"{path} is damaged: {name} needs a finite offset and a finite, positive scale,"
                f" got {part.offset.tolist()} and {part.scale.tolist()}"
            )


def save_tensors(path: str | Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any] | None = None) -> None:
    """Writes tensors and facts to one safetensors file, aside and renamed.

    Args:
        path (str or Path): the file; it is complete or not there.
        tensors (mapping): tensors by name, on any device.
        about (mapping, optional): facts for the header, plain JSON types.
    """
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with replacing_file(path) as aside:
        try:
            # one entry alone: of several the order in the file would be another one every time
            facts = dict(about or {})
            save_file(tensors, aside, metadata={"about": json.dumps(facts | {_SHA256: _digest(tensors, facts)})})
        except SafetensorError as error:  # it has no errno
            raise OSError(errno.EIO, str(error)) from error


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
            metadata = file.metadata() or {"about": "{}"}
        if "about" not in metadata:
            raise ValueError(f"its header has {', '.join(metadata)} instead of facts")
        about = json.loads(metadata["about"])
        if not isinstance(about, dict):
            raise ValueError(f"its facts are no object but {type(about).__name__}")
        tensors = load_file(path)
    except (SafetensorError, ValueError, RecursionError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    facts = {name: value for name, value in about.items() if name != _SHA256}
    if not _is_as_written(tensors, facts, about, metadata["about"]):
        raise CheckpointError(f"{path} is damaged: its content is not what was written (checksum)")
    return tensors, facts


def _is_as_written(
    tensors: Mapping[str, Tensor], facts: Mapping[str, Any], about: Mapping[str, Any], text: str
) -> bool:
    """Whether tensors and facts have their checksum; in files of before that is of the tensors alone, or missing."""
    if _SHA256 not in about:
        called = [name for name, value in facts.items() if isinstance(value, str) and len(value) == _LENGTH]
        rests = [{name: value for name, value in facts.items() if name != other} for other in called]
        return not any(facts[name] == _digest(tensors, rest) for name, rest in zip(called, rests, strict=True))
    if about[_SHA256] == _digest(tensors, facts):
        return json.dumps(about) == text
    return about[_SHA256] == _digest(tensors)


def _digest(tensors: Mapping[str, Tensor], facts: Mapping[str, Any] | None = None) -> str:
    digest = hashlib.sha256()
    if facts is not None:
        digest.update(json.dumps(facts).encode())
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


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
    save_tensors(path, tensors, {**about, "param_groups": state["param_groups"], "moments": len(state["state"])})


def load_training_state(path: str | Path, loss: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Restores what :func:`save_training_state` wrote, the global random state included.

    Args:
        path (str or Path): the file.
        loss (nn.Module): loss module, built as it was; receives its parameters and averages.
        optimizer (torch.optim.Optimizer): optimiser of the same parameters; receives its moments.

    Returns:
        dict: the facts given when it was saved.

    Raises:
        CheckpointError: if the file is damaged, no training state, lacks that of the optimiser, or does not fit the
            loss module or the optimiser. Nothing has been changed then.
    """
    tensors, about = load_tensors(path)
    if "rng.cpu" not in tensors or "param_groups" not in about:
        raise CheckpointError(f"{path} is no state of a training")
    if type(about.get("step")) is not int or about["step"] < 0:
        raise CheckpointError(
            f"{path} is damaged: its step must be a whole number from 0 on, got {about.get('step')!r}"
        )
    wanted = {name: value for name, value in loss.state_dict().items() if isinstance(value, Tensor)}
    saved = {name.removeprefix("loss."): value for name, value in tensors.items() if name.startswith("loss.")}
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
    for old, new in zip(saved, json.loads(json.dumps(now)), strict=True):
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
