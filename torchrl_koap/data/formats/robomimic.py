# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from one HDF5 file in robomimic's layout.

::

    data                     attribute env_args (JSON; env_kwargs/control_freq is the rate)
    data/demo_0/obs/<name>   [T, d] or [T] numbers, side by side the state; images [T, H, W, C] are skipped
    data/demo_0/actions      [T, a]; may be missing
    data/demo_0/next_obs     optional; its last row is the frame behind the last action
"""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.columns import Piece, assemble, spread
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError


def is_hdf5(path: str | Path) -> bool:
    """Whether a path is an HDF5 file, by its name."""
    return Path(path).suffix in (".hdf5", ".h5") and Path(path).is_file()


def read_robomimic(
    file: str | Path,
    *,
    observations: Sequence[str] | None = None,
    **options: Any,
) -> Recordings:
    """Reads trajectories from an HDF5 file.

    Args:
        file (str or Path): the file.
        observations (sequence of str, optional): entries of ``obs`` that make up the state, in that order. Default: all
            that are no images, by name.
        options: of :func:`~torchrl_koap.data.formats.columns.assemble`; the file declares its rate by ``control_freq``
            of ``env_args``.
    """
    if importlib.util.find_spec("h5py") is None:
        raise RuntimeError("HDF5 files are read with an extra: pip install 'torchrl_koap[hdf5]'")
    import h5py

    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"{file} is no file")
    try:
        stream = h5py.File(file, "r")
    except OSError as error:
        raise DataError(file, f"no HDF5 file: {str(error).splitlines()[0]}") from error
    with stream:
        if "data" not in stream or not isinstance(stream["data"], h5py.Group):
            raise DataError(file, f"no group 'data'; the file holds {', '.join(stream) or 'nothing'}")
        demos = sorted(stream["data"], key=_number)
        problems = [f"data/{name} has no group 'obs'" for name in demos if "obs" not in stream[f"data/{name}"]]
        if problems or not demos:
            raise DataError(file, problems or "'data' holds no trajectories")
        first = stream[f"data/{demos[0]}"]
        usable = [name for name in sorted(first["obs"]) if _is_table(first["obs"][name])]
        chosen = usable if observations is None else list(observations)
        if not chosen:
            problems.append(f"no entry of obs is a table of numbers; there are {', '.join(first['obs'])}")
        declared = _control_frequency(stream["data"].attrs.get("env_args"))
        pieces = [_piece(name, stream["data"], chosen, first, problems) for name in demos]
        skipped = [f"obs/{name}" for name in sorted(first["obs"]) if name not in chosen]
        skipped += [name for name in sorted(first) if name not in ("obs", "next_obs", "actions")]
    if problems:
        raise DataError(file, problems)
    return assemble(
        pieces,
        str(file),
        declared_hz=declared,
        skipped=skipped,
        no_rate="env_args holds no control_freq: pass control_hz",
        **options,
    )


def _piece(name: str, data: Any, chosen: Sequence[str], first: Any, problems: list[str]) -> Piece:
    """One demonstration of a group; its entries must have a row per frame, as wide as those of the first one."""
    group, states, lengths = data[name], dict[str, np.ndarray](), dict[str, list[int]]()
    for entry in chosen:
        if entry not in group["obs"]:
            have = ", ".join(sorted(group["obs"]))
            problems.append(f"data/{name}/obs has no entry {entry!r}; it has {have}")
            continue
        place, part = f"obs/{entry}", group["obs"][entry]
        if not _is_table(part):
            shape = list(getattr(part, "shape", ()))
            problems.append(f"data/{name}/{place} is {shape}, no table of numbers: it cannot be part of the state")
            continue
        _check_width(name, place, part, first, problems)
        part = np.asarray(part)
        if "next_obs" in group and all(other in group["next_obs"] for other in chosen):
            behind = np.asarray(group["next_obs"][entry])
            if behind.shape[1:] != part.shape[1:] or not len(behind):
                problems.append(f"data/{name}/next_{place} is {list(behind.shape)}, {place} is {list(part.shape)}")
                continue
            part = np.concatenate([part, behind[-1:]])
        states |= spread(entry, part)
        lengths[entry] = list(part.shape)
    if len({shape[0] for shape in lengths.values()}) > 1:
        shapes = ", ".join(f"{entry} {shape}" for entry, shape in lengths.items())
        problems.append(f"data/{name}/obs: entries have different numbers of frames: {shapes}")
    if "actions" not in group:
        return Piece(name, states)
    if not _is_table(group["actions"]):
        shape = list(getattr(group["actions"], "shape", ()))
        problems.append(f"data/{name}/actions must be numbers [T, a], got {shape}")
        return Piece(name, states)
    _check_width(name, "actions", group["actions"], first, problems)
    actions = np.asarray(group["actions"])
    columns = actions.reshape(len(actions), -1).T
    return Piece(name, states, {f"action_{index}": values for index, values in enumerate(columns)})


def _check_width(name: str, place: str, part: Any, first: Any, problems: list[str]) -> None:
    if place in first and _is_table(first[place]) and part.shape[1:] != first[place].shape[1:]:
        wanted = f"{first[place].name.removeprefix('/')} is {list(first[place].shape)}"
        problems.append(f"data/{name}/{place} is {list(part.shape)}, {wanted}")


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits[0]) if digits else -1, name)


def _is_table(entry: Any) -> bool:
    import h5py

    return isinstance(entry, h5py.Dataset) and entry.ndim in (1, 2) and entry.dtype.kind in "fiub"


def _control_frequency(text: Any) -> float | None:
    try:
        value = json.loads(text)["env_kwargs"]["control_freq"]
    except (TypeError, ValueError, KeyError):
        return None
    return float(value) if isinstance(value, (int, float)) and value > 0 else None
