# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from one HDF5 file in robomimic's layout.

::

    data                     attribute env_args (JSON; env_kwargs/control_freq is the rate)
    data/demo_0/obs/<name>   [T, d] or [T] numbers, side by side the state; frames of a camera [T, H, W, 3]
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

from torchrl_koap.data.formats.columns import Piece, assemble, kind_of, spread
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError


def is_hdf5(path: str | Path) -> bool:
    """Whether a path is an HDF5 file, by its name."""
    return Path(path).suffix in (".hdf5", ".h5") and Path(path).is_file()


def read_robomimic(file: str | Path, *, observations: Sequence[str] | None = None, **options: Any) -> Recordings:
    """Reads trajectories from an HDF5 file, which declares its rate by ``control_freq`` of ``env_args``.

    Args:
        file (str or Path): the file.
        observations (sequence of str, optional): entries of ``obs`` that make up the state, in that order. Default: all
            that are no images, by name.
        options: of :func:`~torchrl_koap.data.formats.columns.assemble`.
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
        problems = [
            f"data/{name} has no group 'obs'"
            for name in demos
            if not isinstance(stream["data"][name].get("obs"), h5py.Group)
        ]
        if problems or not demos:
            raise DataError(file, problems or "'data' holds no trajectories")
        first = stream[f"data/{demos[0]}"]
        entries = {name: part for demo in demos for name, part in stream[f"data/{demo}/obs"].items()}
        usable = sorted(name for name, part in entries.items() if _is_table(part))
        chosen = usable if observations is None else list(observations)
        if not chosen:
            problems.append(f"no entry of obs is a table of numbers; there are {', '.join(first['obs'])}")
        declared = _control_frequency(stream["data"].attrs.get("env_args"))
        pieces = [_piece(stream[f"data/{name}"], name, chosen, problems) for name in demos]
        seen = {name for piece in pieces for name in piece.cameras}
        skipped = [f"obs/{name}" for name in sorted(entries) if name not in chosen and name not in seen]
        read = ("obs", "next_obs", "actions")
        skipped += [name for name in sorted(first) if name not in read and kind_of(name)[0] != "clock"]
        skipped += [name for name in stream if name != "data"]
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


def _piece(group: Any, name: str, chosen: Sequence[str], problems: list[str]) -> Piece:
    """One demonstration."""
    states: dict[str, np.ndarray] = {}
    following = group.get("next_obs", {})
    behind = all(entry in following for entry in chosen)
    for entry in chosen:
        part = group["obs"].get(entry)
        if part is None:
            problems.append(f"data/{name}/obs has no entry {entry!r}; it has {', '.join(sorted(group['obs']))}")
        elif not _is_table(part):
            said = "no table of numbers: it cannot be part of the state"
            problems.append(f"data/{name}/obs/{entry} is {_shape(part)}, {said}")
        else:
            last = following[entry] if behind else part[:0]
            if _shape(last)[1:] != _shape(part)[1:] or behind and not len(last):
                problems.append(f"data/{name}/next_obs/{entry} is {_shape(last)}, obs/{entry} is {_shape(part)}")
                continue
            states |= spread(entry, np.concatenate([part, last[-1:]]))
    if not behind:  # time stamps may lie beside obs
        stamps = [entry for entry in group if kind_of(entry)[0] == "clock" and _is_table(group[entry])]
        states = {entry: group[entry][()].ravel() for entry in stamps} | states
    file, cameras = str(Path(group.file.filename).resolve()), {}
    for film, part in group["obs"].items():
        if len(_shape(part)) == 4:  # where nobody kept the frame behind the last one, that one is taken again
            last = (len(part) - (film not in following),) if behind else ()
            cameras[film] = Clip(file, (*range(len(part)), *last), f"data/{name}/obs/{film}")
    if "actions" not in group:
        return Piece(name, states, cameras=cameras)
    actions = group["actions"]
    if not _is_table(actions):
        problems.append(f"data/{name}/actions must be numbers [T, a], got {_shape(actions)}")
        return Piece(name, states)
    columns = spread("action", actions).values()
    return Piece(name, states, {f"action_{index}": values for index, values in enumerate(columns)}, cameras=cameras)


def _shape(entry: Any) -> list[int]:
    return list(getattr(entry, "shape", ()))


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
