# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from HDF5 files in robomimic's layout, or in ALOHA's.

::

    data                     attribute env_args (JSON; env_kwargs/control_freq is the rate)
    data/demo_0/obs/<name>   [T, d] or [T] numbers, side by side the state; frames of a camera [T, H, W, 3]
                             or JPEG or PNG files [T, bytes]
    data/demo_0/actions      [T, a]; may be missing
    data/demo_0/next_obs     optional; its last row is the frame behind the last action, the others repeat obs
    data/demo_0/dones        optional, as time stamps, counters and numbers of episodes: [T] beside obs

    observations/<name>      [T, d] in ALOHA's layout, a demonstration per file
    observations/images/<name>   frames of a camera
    action                   [T, a]; may be missing
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.clocks import declared_rate
from torchrl_koap.data.formats.columns import Piece, assemble
from torchrl_koap.data.formats.frames import MAGIC, Clip
from torchrl_koap.data.formats.kinds import as_numbers, kind_of, numbered, spread
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError, gathered, option, refuse
from torchrl_koap.lookup import import_extra

NEXT = "next_obs"
BESIDE = ("episode", "frame", "start", "end")  # what entries beside the observations may be
_SAME, _ROUNDED = 1e-3, 1e-6  # share of a column's range, and of its numbers, that is rounding


def hdf5_files(source: str | Path) -> list[Path]:
    """Finds the HDF5 files in a folder, in the order of their numbers; one that is given itself is the only one."""
    beside = sorted(Path(source).glob("[!.]*"), key=lambda path: _number(path.stem))
    found = [Path(source)] if Path(source).is_file() else beside
    return [path for path in found if path.suffix.lower() in (".hdf5", ".h5") and path.is_file()]


def read_robomimic(
    file: str | Path, *, observations: Sequence[str] | None = None, drop_columns: Sequence[str] = (), **options: Any
) -> Recordings:
    """Reads trajectories from an HDF5 file, or a folder of them.

    Robomimic's declare their rate by ``control_freq`` of ``env_args``. ``observations`` are the entries of ``obs`` that
    make up the state, in that order. Default: all that are no images, by name. ``next_obs`` is one of the
    ``drop_columns``, too. The options are those of
    :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    h5py = import_extra("h5py", "hdf5", "HDF5 files are read with")
    files = hdf5_files(file)
    if not files:
        raise FileNotFoundError(f"{file} is no HDF5 file, and no folder of them")
    pieces, rates, skipped = [], {}, []
    for each in files:
        try:
            with h5py.File(each, "r") as stream:
                found, rates[each], unread = _read(stream, each, observations, use_next=NEXT not in drop_columns)
        except OSError as error:
            raise DataError(each, "it is no HDF5 file, or damaged") from error
        several = len(files) > 1 and len(found) > 1
        pieces += [replace(piece, name=f"{each.stem}/{piece.name}") if several else piece for piece in found]
        skipped += unread
    if len({*rates.values()}) > 1:
        raise DataError(
            file, f"its files declare other rates: {', '.join(f'{each.name} {hz}' for each, hz in rates.items())}"
        )
    return assemble(
        pieces,
        str(file),
        declared_hz=next(iter(rates.values())),
        skipped=skipped,
        drop_columns=[name for name in drop_columns if name != NEXT],
        no_rate="env_args holds no control_freq",
        **options,
    )


def _read(
    stream: Any, file: Path, observations: Sequence[str] | None, *, use_next: bool
) -> tuple[list[Piece], float | None, list[str]]:
    """Demonstrations, the rate that is declared, and what is not read."""
    data = stream.get("data") if "observations" not in stream else {file.stem: _aloha(stream)}
    if not isinstance(data, Mapping):  # as groups are
        wanted = (
            "wanted the layout of robomimic (data/demo_0/obs, data/demo_0/actions), or ALOHA's (observations, action)"
        )
        raise DataError(file, f"no group 'data', {wanted}; the file holds {', '.join(stream) or 'nothing'}")
    demos = sorted((name for name in data if isinstance(data.get(name), Mapping)), key=_number)
    lacking = [name for name in demos if not isinstance(data[name].get("obs"), Mapping)]
    faults = [(f"data/{name}", "it has no group 'obs'") for name in lacking]
    if faults or not demos:
        raise DataError(file, gathered(faults) or "'data' holds no trajectories")
    first = data[demos[0]]
    entries = {name: data[demo]["obs"].get(name) for demo in demos for name in data[demo]["obs"]}
    usable = sorted(name for name, part in entries.items() if _is_table(part))
    chosen = usable if observations is None else list(observations)
    if not chosen:
        faults.append(("data/*/obs", f"no entry is a table of numbers; there are {', '.join(first['obs'])}"))
    followed = {name for name in demos if use_next and all(entry in data[name].get(NEXT, {}) for entry in chosen)}
    pieces = [_piece(data[name], name, chosen, faults, behind=name in followed) for name in demos]
    refuse(file, gathered(faults))
    seen = {name for piece in pieces for name in (*piece.states, *piece.cameras)}
    skipped = [f"obs/{name}" for name in sorted(entries) if name not in chosen and name not in seen]
    skipped += [name for name in sorted(first) if name not in ("obs", NEXT, "actions", *seen)]
    skipped += [NEXT] if any(NEXT in data[name] for name in {*demos} - followed) else []
    skipped += [f"data/{name} (no group)" for name in data if name not in demos]
    said = {"mask": "mask (every demonstration is read)"}
    skipped += [said.get(name, name) for name in stream if "data" in stream and name != "data"]
    return pieces, _control_frequency(getattr(data, "attrs", {}).get("env_args")), skipped


def _aloha(stream: Any) -> dict[str, Any]:
    """The one demonstration of a file in ALOHA's layout, as one in robomimic's."""
    beside, observed = {**stream}, {**stream["observations"]}
    observed |= observed.pop("images", {})
    del beside["observations"]
    return {"obs": observed} | {"actions" if name == "action" else name: part for name, part in beside.items()}


def _piece(group: Any, name: str, chosen: Sequence[str], faults: list[tuple[str, str]], *, behind: bool) -> Piece:
    states: dict[str, np.ndarray] = {}
    following = group[NEXT] if behind else {}
    for entry in chosen:
        part = group["obs"].get(entry)
        last = following[entry] if behind else part
        if part is None:
            said = f"obs has no entry {entry!r}; it has {', '.join(sorted(group['obs']))}"
        elif not _is_table(part):
            said = f"obs/{entry} is {_shape(part)}, no table of numbers: it cannot be part of the state"
        elif _shape(last) != _shape(part):
            said = f"next_obs/{entry} is {_shape(last)}, obs/{entry} is {_shape(part)}"
        elif behind and (odd := _other_frame(part[()], last[()])) is not None:
            said = (
                f"row {odd} of next_obs/{entry} is not row {odd + 1} of obs/{entry}: are frames missing, or out of"
                f" order? if next_obs means nothing, leave it out by {option('drop_columns')} next_obs"
            )
        else:
            states |= spread(entry, np.concatenate([part, last[-1:]] if behind else [part]))
            continue
        faults.append((f"data/{name}", said))
    if not behind:  # time stamps, counters and ends of episodes may lie beside obs
        frames = len(next(iter(states.values()), ()))
        for entry, part in group.items():
            kind, single = kind_of(entry)[0], len(_shape(part)) > 0 and part.size == len(part)
            if single and (kind == "clock" or kind in BESIDE and len(part) == frames):
                beside = as_numbers(entry, part[()].ravel())
                states = states if beside is None else {entry: beside} | states
    cameras = {}
    for film, part in group["obs"].items():
        if len(_shape(part)) == 4 or _is_compressed(part):
            # where nobody kept the frame behind the last one, that one is taken again
            last = (len(part) - (film not in following),) if behind else ()
            file = str(Path(part.file.filename).resolve())
            cameras[film] = Clip(file, (*range(len(part)), *last), part.name.removeprefix("/"))
    actions = group.get("actions")
    if actions is not None and not _is_table(actions):
        faults.append((f"data/{name}", f"actions must be numbers [T, a], got {_shape(actions)}"))
    steps = numbered("action", actions) if _is_table(actions) else {}
    return Piece(name, states, steps or None, cameras=cameras)


def _other_frame(frames: np.ndarray, following: np.ndarray) -> int | None:
    """The first row ``[T, d]`` that is not the one that followed it by the next observations; None if all are."""
    frames, following = (part.reshape(len(part), -1).astype(np.float64) for part in (frames, following))
    if len(frames) < 2:
        return None
    off = np.abs(following[:-1] - frames[1:]) > _SAME * np.ptp(frames, axis=0) + _ROUNDED * np.abs(frames).max()
    return int(off.any(-1).argmax()) if off.any() else None


def _shape(entry: Any) -> list[int]:
    import h5py

    return list(entry.shape or ()) if isinstance(entry, h5py.Dataset) else []


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits[0]) if digits else -1, name)


def _is_table(entry: Any) -> bool:
    return len(_shape(entry)) in (1, 2) and entry.dtype.kind in "fiub" and not _is_compressed(entry)


def _is_compressed(entry: Any) -> bool:
    """Whether every row is the content of a picture's file."""
    if len(_shape(entry)) not in (1, 2) or not len(entry) or entry.dtype.kind not in "uOSV":
        return False
    return np.asarray(entry[0]).tobytes().startswith(MAGIC)


def _control_frequency(text: Any) -> float | None:
    try:
        return declared_rate(json.loads(text)["env_kwargs"]["control_freq"])
    except (TypeError, ValueError, KeyError):
        return None
