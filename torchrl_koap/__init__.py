# This source code is licensed under the MIT license found in the LICENSE file.
"""TorchRL components for imitation learning with few action labels."""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public names, imported when they are asked for: the package itself imports neither torch nor a simulator
_LAZY = {"Task": "torchrl_koap.tasks", "get_task": "torchrl_koap.tasks", "register_task": "torchrl_koap.tasks"}

__all__ = ["Task", "__version__", "get_task", "register_task"]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
