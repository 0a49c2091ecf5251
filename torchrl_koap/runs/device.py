# This source code is licensed under the MIT license found in the LICENSE file.
"""Threads and device of a process, and the number type of a planner's matrix products."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator

import torch

# number type of a denoiser's matrix products in training; None: that of its weights
DTYPES = {"float32": None, "bfloat16": torch.bfloat16}
PRECISIONS = (*DTYPES, "auto")
_MOST_THREADS = 1024
_BFLOAT16 = ("amx_bf16", "avx512_bf16")  # flags of processors that multiply bfloat16 matrices


def find_precision(precision: str, device: str | torch.device = "cpu") -> str:
    """Resolves "auto" for a device: "bfloat16" if it has units for it, else "float32".

    Warns if "bfloat16" was asked for by name and is emulated.
    """
    if precision == "float32":
        return precision
    fast = has_bfloat16_units(device)
    if precision == "auto":
        return "bfloat16" if fast else "float32"
    if not fast:
        message = f"precision 'bfloat16': {torch.device(device).type} has no units for it and emulates it"
        warnings.warn(f"{message}, many times slower than 'float32'; 'auto' chooses the faster one", stacklevel=2)
    return precision


def has_bfloat16_units(device: str | torch.device = "cpu") -> bool:
    """Returns whether a device, ``"cpu"`` or ``"cuda"``, has hardware that multiplies bfloat16 matrices."""
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    features = torch.cpu.get_capabilities()
    return any(features.get(name, False) for name in _BFLOAT16)


def default_threads() -> int:
    """Returns the default number of threads: ``OMP_NUM_THREADS``, else 1, as two would wait for other programs."""
    return torch.get_num_threads() if os.environ.get("OMP_NUM_THREADS") else 1


@contextlib.contextmanager
def torch_as_before() -> Iterator[None]:
    """Restores torch's number of threads and random state at the end of the block, for the calling program."""
    threads = torch.get_num_threads()
    devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else []
    try:
        with torch.random.fork_rng(devices):
            yield
    finally:
        torch.set_num_threads(threads)


def set_up_torch(threads: int | None, device: str) -> None:
    """Sets the number of threads unless it is None; raises a ValueError if this machine lacks the device."""
    check_machine(threads, device)
    kind, _, index = device.partition(":")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {device!r} was asked for, but torch finds no CUDA here (see `koap doctor`)")
    if kind == "cuda" and int(index or 0) >= torch.cuda.device_count():
        raise ValueError(f"device {device!r} was asked for, but there are {torch.cuda.device_count()}, counted from 0")
    if threads is not None:
        torch.set_num_threads(threads)


def check_machine(threads: int | None, device: str) -> None:
    """Raises a ValueError for a number of threads or a device name that no machine has."""
    if threads is not None and not 1 <= threads <= _MOST_THREADS:
        raise ValueError(f"threads must be 1 to {_MOST_THREADS}, got {threads}")
    kind, colon, index = device.partition(":")
    numbered = not colon or index.isdecimal()
    if kind not in ("cpu", "cuda") or not numbered or (kind == "cpu" and int(index or 0) > 0):
        raise ValueError(f"device must be 'cpu' or 'cuda', got {device!r}")
