# This source code is licensed under the MIT license found in the LICENSE file.
"""What a memory-mapped data set may be made of: plain files inside its folder, of the sizes its description says.

A data set may have been sent by somebody. Its description names the files of its entries; none of these names may lead
out of the folder, by ``..``, by a separator or by a link, and no file may be shorter than the entry that is to be
mapped onto it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from torchrl_koap.files import read_bytes

_META = "meta.json"


def steps_problem(steps: Path) -> str | None:
    """The first thing that is wrong with the files of a data set's entries, None if nothing is.

    Args:
        steps (Path): folder that :meth:`tensordict.TensorDict.memmap` wrote.

    Examples:
        >>> import os, tempfile
        >>> from pathlib import Path
        >>> from torchrl_koap.data.ted_guard import steps_problem
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     os.symlink("/etc/hosts", f"{folder}/action.memmap")
        ...     steps_problem(Path(folder)).removeprefix(folder)
        '/action.memmap is a link or no plain file; a data set holds plain files alone'
    """
    for path in (steps, *sorted(steps.rglob("*"))):
        if path.is_symlink() or not (path.is_dir() or path.is_file()):
            return f"{path} is a link or no plain file; a data set holds plain files alone"
    for path in sorted(steps.rglob(_META)):
        try:
            entries = json.loads(read_bytes(path))
            problem = next(_problems(path.parent, entries), None)
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            problem = f"it cannot be read: {error}"
        if problem is not None:
            return f"{path}: {problem}"
    return None


def _problems(folder: Path, entries: Any) -> Iterator[str]:
    if not isinstance(entries, dict):
        yield f"wanted an object, got {type(entries).__name__}"
        return
    kind = entries.get("_type", "<class 'tensordict._td.TensorDict'>")
    if kind != "<class 'tensordict._td.TensorDict'>":
        yield f"it is of type {kind!r}; only plain tensordicts are read"
    for name, entry in entries.items():
        if not isinstance(entry, dict):
            continue
        if name in ("", ".", "..") or any(character in name for character in "/\\\0"):
            yield f"entry {name!r} leads out of its folder"
        if entry.get("type", "TensorDict") != "TensorDict":
            yield f"entry {name!r} is of type {entry['type']!r}; only tensors are read"
        if "type" in entry:
            continue
        dtype = getattr(torch, str(entry.get("dtype")).removeprefix("torch."), None)
        shape = entry.get("shape")
        sound = isinstance(shape, list) and all(type(size) is int and size >= 0 for size in shape)
        if not isinstance(dtype, torch.dtype) or not sound:
            yield f"entry {name!r} has no shape and element type"
            continue
        file = folder / f"{name}.memmap"
        needed = math.prod(shape) * dtype.itemsize
        if needed and file.is_file() and file.stat().st_size != needed:
            yield f"entry {name!r} needs {needed:,} bytes, {file.name} has {file.stat().st_size:,}"
