# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from one HDF5 file in robomimic's layout.

::

    data                     attribute env_args (JSON; env_kwargs/control_freq is the rate)
    data/demo_0/obs/<name>   [T, d] or [T] numbers, side by side the state; frames of a camera [T, H, W, 3]
    data/demo_0/actions      [T, a]; may be missing
    data/demo_0/dones        optional, as time stamps, counters and numbers of episodes: [T] beside obs

``next_obs`` repeats ``obs``, all but its last row, and is not read.
"""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.columns import Piece, assemble
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.kinds import as_numbers, kind_of, spread
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError, gathered

BESIDE = ("episode", "frame", "start", "end")  # what entries beside the observations may be


def is_hdf5(path: str | Path) -> bool:
    """Whether a path is an HDF5 file, by its name."""
    return Path(path).suffix.lower() in (".hdf5", ".h5") and Path(path).is_file()


def read_robomimic(file: str | Path, *, observations: Sequence[str] | None = None, **options: Any) -> Recordings:
    """Reads trajectories from an HDF5 file, which declares its rate by ``control_freq`` of ``env_args``.

    ``observations`` are the entries of ``obs`` that make up the state, in that order. Default: all that are no images,
    by name. The options are those of :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    if importlib.util.find_spec("h5py") is None:
        raise RuntimeError("HDF5 files are read with an extra: pip install 'torchrl_koap[hdf5]'")
    import h5py

    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"{file} is no file")
    try:
        with h5py.File(file, "r") as stream:
            pieces, declared, skipped = _read(stream, file, observations)
    except OSError as error:
        raise DataError(file, "it is no HDF5 file, or damaged") from error
    return assemble(
        pieces,
        str(file),
        declared_hz=declared,
        skipped=skipped,
        no_rate="env_args holds no control_freq",
        **options,
    )


def _read(stream: Any, file: Path, observations: Sequence[str] | None) -> tuple[list[Piece], float | None, list[str]]:
    """Demonstrations, the rate that is declared, and what is not read."""
    if not _is_group(stream.get("data")):
        wanted = "wanted the layout of robomimic (data/demo_0/obs, data/demo_0/actions)"
        raise DataError(file, f"no group 'data', {wanted}; the file holds {', '.join(stream) or 'nothing'}")
    data = stream["data"]
    demos = sorted((name for name in data if _is_group(data.get(name))), key=_number)
    faults = [(f"data/{name}", "it has no group 'obs'") for name in demos if not _is_group(data[name].get("obs"))]
    if faults or not demos:
        raise DataError(file, gathered(faults) or "'data' holds no trajectories")
    first = data[demos[0]]
    entries = {name: data[demo]["obs"].get(name) for demo in demos for name in data[demo]["obs"]}
    usable = sorted(name for name, part in entries.items() if _is_table(part))
    chosen = usable if observations is None else list(observations)
    if not chosen:
        faults.append(("data/*/obs", f"no entry is a table of numbers; there are {', '.join(first['obs'])}"))
    pieces = [_piece(data[name], name, chosen, faults) for name in demos]
    if faults:
        raise DataError(file, gathered(faults))
    seen = {name for piece in pieces for name in (*piece.states, *piece.cameras)}
    skipped = [f"obs/{name}" for name in sorted(entries) if name not in chosen and name not in seen]
    skipped += [name for name in sorted(first) if name not in ("obs", "actions", *seen)]
    skipped += [f"data/{name} (no group)" for name in data if name not in demos]
    skipped += [name for name in stream if name != "data"]
    return pieces, _control_frequency(data.attrs.get("env_args")), skipped


def _piece(group: Any, name: str, chosen: Sequence[str], faults: list[tuple[str, str]]) -> Piece:
    states: dict[str, np.ndarray] = {}
    for entry in chosen:
        part = group["obs"].get(entry)
        if part is None:
            faults.append((f"data/{name}", f"obs has no entry {entry!r}; it has {', '.join(sorted(group['obs']))}"))
        elif not _is_table(part):
            said = f"obs/{entry} is {_shape(part)}, no table of numbers: it cannot be part of the state"
            faults.append((f"data/{name}", said))
        else:
            states |= spread(entry, part)
    frames = len(next(iter(states.values()), ()))
    for entry, part in group.items():  # time stamps, counters and ends of episodes may lie beside obs
        kind, single = kind_of(entry)[0], len(_shape(part)) > 0 and part.size == len(part)
        if single and (kind == "clock" or kind in BESIDE and len(part) == frames):
            beside = as_numbers(entry, part[()].ravel())
            states = states if beside is None else {entry: beside} | states
    file = str(Path(group.file.filename).resolve())
    cameras = {
        film: Clip(file, tuple(range(len(part))), f"data/{name}/obs/{film}")
        for film, part in group["obs"].items()
        if len(_shape(part)) == 4
    }
    actions = group.get("actions")
    if actions is not None and not _is_table(actions):
        faults.append((f"data/{name}", f"actions must be numbers [T, a], got {_shape(actions)}"))
    columns = spread("action", actions).values() if _is_table(actions) else ()
    steps = {f"action_{index}": values for index, values in enumerate(columns)}
    return Piece(name, states, steps or None, cameras=cameras)


def _shape(entry: Any) -> list[int]:
    import h5py

    return list(entry.shape or ()) if isinstance(entry, h5py.Dataset) else []


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits[0]) if digits else -1, name)


def _is_table(entry: Any) -> bool:
    return len(_shape(entry)) in (1, 2) and entry.dtype.kind in "fiub"


def _is_group(entry: Any) -> bool:
    import h5py

    return isinstance(entry, h5py.Group)


def _control_frequency(text: Any) -> float | None:
    try:
        value = json.loads(text)["env_kwargs"]["control_freq"]
    except (TypeError, ValueError, KeyError):
        return None
    return float(value) if isinstance(value, (int, float)) and value > 0 else None
