# This source code is licensed under the MIT license found in the LICENSE file.
"""What ``config.json`` keeps of a training: every option, what was built from them, the command, the versions."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.tasks.registry import is_adopted
from torchrl_koap.training.resolved import ResolvedConfig

# what is derived from these may differ from version to version
_RECORDED = ("observation", "action", "has_action", "episode", "step_count", ("next", "observation"), ("next", "done"))
_PACKAGES = ("torchrl_koap", "torch", "torchrl", "tensordict", "mujoco")


def to_json(resolved: ResolvedConfig, command: str | None = None) -> dict[str, Any]:
    """Everything that ``config.json`` holds, as plain values.

    Args:
        resolved (ResolvedConfig): the options.
        command (str, optional): how the training was called, where it was called from a shell.
    """
    options = asdict(resolved.options)
    content = {name: _plain(value) for name, value in options.items()}
    if is_adopted(resolved.task):
        content["task_definition"] = resolved.task.to_json()  # nobody has registered it: it comes with the data
    content |= {"planner": resolved.planner, "controller": resolved.controller}
    if command is not None:
        content["command"] = command
    return content | {"versions": versions()}


def fingerprint(data: TensorDictBase) -> dict[str, Any]:
    """What tells data from others: their size, and a checksum of what was recorded.

    Args:
        data (TensorDictBase): flat data ``[N]``, on any device.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.training.provenance import fingerprint
        >>> one, other = (TensorDict({"action": torch.tensor([[0.0], [last]])}, [2]) for last in (1.0, 2.0))
        >>> fingerprint(one) == fingerprint(one.clone()), fingerprint(one) == fingerprint(other)
        (True, False)
    """
    digest = hashlib.sha256()
    present = set(data.keys(True, True))
    for name in [name for name in _RECORDED if name in present]:
        value = data.get(name).detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy())
    return {"steps": len(data), "sha256": digest.hexdigest()}


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in _PACKAGES}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)
