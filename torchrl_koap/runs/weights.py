# This source code is licensed under the MIT license found in the LICENSE file.
"""Weights as safetensors with a JSON header; published weights are int8 and have 25 % of the size."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from torchrl_koap.files import replacing_file

_SHA256 = "sha256"  # header entry: checksum of the tensors and the other facts
ROW_SCALE = ".row_scale"  # suffix of the scales of a matrix that is stored as int8


class CheckpointError(ValueError):
    """A weights file that cannot be used: damaged, of another task, or without its statistics."""


def load_weights(path: str | Path, module: nn.Module, expected: Mapping[str, Any]) -> None:
    """Loads weights, normaliser statistics included, into a module of the same architecture.

    ``expected`` are the facts that the file must hold: the task, and the options that build the module. A
    CheckpointError names what is missing, damaged, or of another task, other options or other shapes.
    """
    tensors, about = load_tensors(path)
    for name, value in expected.items():
        if about.get(name) != value:
            raise CheckpointError(f"{path} was trained on {name} {about.get(name)!r}, not on {value!r}")
    _load(path, module, expand(tensors))


def load_parts(path: str | Path, tensors: Mapping[str, Tensor], parts: Mapping[str, nn.Module | None]) -> None:
    """Loads the weights of several modules from tensors named ``"PART.ENTRY"``; skips parts that are None."""
    for part, module in parts.items():
        if module is not None:
            own = {name.removeprefix(f"{part}."): t for name, t in tensors.items() if name.startswith(f"{part}.")}
            _load(f"{path} ({part})", module, own)


def _load(path: str | Path, module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    kinds = {value.dtype for value in tensors.values() if value.is_floating_point()}
    if len(kinds) == 1:
        module.to(kinds.pop())  # the number type of the training, whatever torch's default is
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        problems = " ".join(str(error).split("\n", 1)[-1].split())
        raise CheckpointError(f"{path} does not fit the model: {problems}") from error


def save_tensors(path: str | Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any] | None = None) -> None:
    """Writes tensors by name, and facts of plain JSON types, to one safetensors file, atomically."""
    tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with replacing_file(path) as aside:
        # a single entry, as the order of several in the file would vary
        facts = dict(about or {})
        save_file(tensors, aside, metadata={"about": json.dumps(facts | {_SHA256: _digest(tensors, facts)})})


def load_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Reads what :func:`save_tensors` wrote; a CheckpointError names a file that is missing or damaged."""
    if not Path(path).is_file():
        raise CheckpointError(f"{path} is missing")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {"about": "{}"}
        if "about" not in metadata:
            raise ValueError(f"its header has {', '.join(metadata)} instead of 'about'")
        about = json.loads(metadata["about"])
        if not isinstance(about, dict):
            raise ValueError(f"its header entry 'about' must be an object, got {type(about).__name__}")
        tensors = load_file(path)
    except (SafetensorError, ValueError, RecursionError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}") from error
    facts = {name: value for name, value in about.items() if name != _SHA256}
    if about.get(_SHA256) != _digest(tensors, facts) or json.dumps(about) != metadata["about"]:
        raise CheckpointError(f"{path} is damaged: its content does not match its checksum")
    return tensors, facts


def _digest(tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> str:
    return digest_of(sorted(tensors.items()), json.dumps(facts).encode())


def digest_of(named: Iterable[tuple[Any, Tensor]], start: bytes = b"") -> str:
    """Computes the SHA-256 of bytes followed by tensors with their names, types and shapes."""
    digest = hashlib.sha256(start)
    for name, tensor in named:
        value = tensor.detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def expand(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Multiplies matrices ``NAME`` (int8) by ``NAME.row_scale``, ``[rows, 1, ...]``; keeps other tensors."""
    return {
        name: tensor.float() * tensors[name + ROW_SCALE] if name + ROW_SCALE in tensors else tensor
        for name, tensor in tensors.items()
        if not (name.endswith(ROW_SCALE) and name.removesuffix(ROW_SCALE) in tensors)
    }
