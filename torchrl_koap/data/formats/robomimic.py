# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads recordings from HDF5 files in the layout of robomimic or ALOHA.

::

    data                     attribute env_args (JSON; env_kwargs/control_freq is the rate)
    data/demo_0/obs/<name>   [T, d] or [T] numbers, side by side the state; frames of a camera [T, H, W, 3]
                             or JPEG or PNG files [T, bytes]; <name> may be a path, such as arm/joints
    data/demo_0/actions      [T, a]; may be missing
    data/demo_0/next_obs     optional; its last row is the frame after the last action, the others repeat obs
    data/demo_0/timeouts     optional, like time stamps, counters and numbers of episodes: [T] beside obs; dones are
                             not read: they mark success, so they may change several times

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
from torchrl_koap.data.formats.columns import assemble
from torchrl_koap.data.formats.frames import MAGIC, Clip
from torchrl_koap.data.formats.kinds import as_numbers, kind_of, named_twice, numbered, spread
from torchrl_koap.data.formats.pieces import Piece, other_frames
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError, gathered, option, refuse
from torchrl_koap.lookup import import_extra

NEXT = "next_obs"
BESIDE = ("episode", "frame", "start", "end")  # kinds of entries that are read beside obs


def hdf5_files(source: str | Path) -> list[Path]:
    """Returns the HDF5 files of a folder in the order of their numbers, or ``source`` if it is one."""
    beside = sorted(Path(source).glob("[!.]*"), key=lambda path: _number(path.stem))
    found = [Path(source)] if Path(source).is_file() else beside
    return [path for path in found if path.suffix.lower() in (".hdf5", ".h5") and path.is_file()]


def read_robomimic(
    file: str | Path, *, observations: Sequence[str] | None = None, drop_columns: Sequence[str] = (), **options: Any
) -> Recordings:
    """Reads trajectories from an HDF5 file, or a folder of them.

    The rate of robomimic's files is ``control_freq`` in ``env_args``. ``observations`` are the entries of ``obs`` that
    make up the state, in this order. Default: all that are not images, by name. ``drop_columns`` may also hold
    ``next_obs``. The options are those of :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    h5py = import_extra("h5py", "hdf5", "HDF5 files are read with")
    files = hdf5_files(file)
    pieces, rates, skipped = [], {}, []
    for each in files:
        try:
            with h5py.File(each, "r") as stream:
                found, rates[each], unread = _read(stream, each, observations, use_next=NEXT not in drop_columns)
        except (OSError, RuntimeError, KeyError, UnicodeDecodeError) as error:  # depending on what is damaged
            raise DataError(each, "it is no HDF5 file, or damaged") from error
        several = len(files) > 1 and len(found) > 1
        pieces += [replace(piece, name=f"{each.stem}/{piece.name}") if several else piece for piece in found]
        skipped += unread
    if len({*rates.values()}) > 1 and "control_hz" not in options:
        said = ", ".join(f"{each.name} {hz}" for each, hz in rates.items())
        cure = f"if all have the same, pass {option('control_hz')}"
        raise DataError(file, f"its files declare different rates: {said}; {cure}")
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
    """Returns demonstrations, the declared rate, and the entries that are not read."""
    aloha = isinstance(stream.get("observations"), Mapping)  # h5py groups are mappings
    called = {"observations": "obs", "action": "actions"}  # ALOHA's names -> robomimic's
    data = {file.stem: {called.get(name, name): part for name, part in stream.items()}} if aloha else stream.get("data")
    if not isinstance(data, Mapping):
        wanted = (
            "wanted the layout of robomimic (data/demo_0/obs, data/demo_0/actions), or ALOHA's (observations, action)"
        )
        cure = "; for one table of all episodes, as in D4RL, np.savez('arm.npz', **{name: part[()] for name, part in"
        cure += f" h5py.File({file.name!r}).items() if isinstance(part, h5py.Dataset)}})"
        cure = cure if _is_table(stream.get("observations")) else ""
        raise DataError(file, f"no group 'data', {wanted}; the file holds {', '.join(stream) or 'nothing'}{cure}")
    demos = sorted((name for name in data if isinstance(data.get(name), Mapping)), key=_number)
    lacking = [name for name in demos if not isinstance(data[name].get("obs"), Mapping)]
    cures = {name: " yet; robomimic's dataset_states_to_obs.py adds it" for name in lacking if "states" in data[name]}
    faults = [(f"data/{name}", f"it has no group 'obs'{cures.get(name, '')}") for name in lacking]
    if faults or not demos:
        raise DataError(file, gathered(faults) or "'data' holds no trajectories")
    entries = {name: part for demo in demos for name, part in _entries(data[demo]["obs"]).items()}
    usable = sorted(name for name, part in entries.items() if _is_table(part))
    chosen = usable if observations is None else list(observations)
    if not chosen:
        faults.append(("data/*/obs", f"no entry is a table of numbers; there are {', '.join(entries)}"))
    following = {name: data[name].get(NEXT) for name in demos if use_next}
    following = {name: _entries(part) for name, part in following.items() if isinstance(part, Mapping)}
    with_next = {name for name, parts in following.items() if chosen and all(entry in parts for entry in chosen)}
    pieces = [_piece(data[name], name, chosen, faults, has_next=name in with_next) for name in demos]
    refuse(file, gathered(faults))
    seen = {name for piece in pieces for name in (*piece.states, *piece.cameras)}
    skipped = [f"obs/{name}" for name in sorted(entries) if name not in chosen and _camera(name) not in seen]
    held = {name for demo in demos for name in data[demo]}
    skipped += sorted(held - {"obs", NEXT, "actions", *seen})
    skipped += [NEXT] if any(NEXT in data[name] for name in {*demos} - with_next) else []
    skipped += [f"data/{name} (no group)" for name in data if name not in demos]
    others = [name for name in _entries(stream) if "data" in stream and not name.startswith("data/")]
    skipped += [f"{name} (every demonstration is read)" if name.startswith("mask/") else name for name in others]
    return pieces, _control_frequency(getattr(data, "attrs", {}).get("env_args")), skipped


def _entries(group: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Returns the data sets of a group, and of the groups in it, by path."""
    found: dict[str, Any] = {}
    for name in group:
        part = group.get(name)
        found |= _entries(part, f"{above}{name}/") if isinstance(part, Mapping) else {f"{above}{name}": part}
    return found


def _camera(path: str) -> str:
    """Returns the name of a camera, which also names files."""
    return path.removeprefix("images/").replace("/", "_")


def _piece(group: Any, name: str, chosen: Sequence[str], faults: list[tuple[str, str]], *, has_next: bool) -> Piece:
    states: dict[str, np.ndarray] = {}
    observed, following = _entries(group["obs"]), group[NEXT] if has_next else {}
    for entry in chosen:
        part = observed.get(entry)
        last = following[entry] if has_next else part
        if part is None:
            said = f"obs has no entry {entry!r}; it has {', '.join(sorted(observed))}"
        elif not _is_table(part):
            said = f"obs/{entry} is {_shape(part)}, no table of numbers: it cannot be part of the state"
        elif _shape(last) != _shape(part):
            said = f"next_obs/{entry} is {_shape(last)}, obs/{entry} is {_shape(part)}"
        elif has_next and (other := other_frames(part[()], last[()])).any():
            odd = int(other.argmax())
            said = (
                f"row {odd} of next_obs/{entry} is not row {odd + 1} of obs/{entry}: are frames missing, or out of"
                f" order? if next_obs is unused, drop it with {option('drop_columns')} next_obs"
            )
        else:
            columns = spread(entry, np.concatenate([part, last[-1:]] if has_next else [part]))
            faults += [(f"data/{name}", fault) for fault in named_twice(states, columns)]
            states |= columns
            continue
        faults.append((f"data/{name}", said))
    if not has_next:  # time stamps, counters and ends of episodes may be beside obs
        frames = len(next(iter(states.values()), ()))
        for entry, part in group.items():
            kind, single = kind_of(entry)[0], len(_shape(part)) > 0 and part.size == len(part)
            if single and entry != "dones" and (kind == "clock" or kind in BESIDE and len(part) == frames):
                beside = as_numbers(entry, part[()].ravel())
                states = states if beside is None else {entry: beside} | states
    cameras: dict[str, Clip] = {}
    for film, part in observed.items():
        if len(_shape(part)) == 4 or _is_compressed(part):
            # without next_obs of this camera, its last frame is repeated
            last = (len(part) - (film not in following),) if has_next else ()
            file = str(Path(part.file.filename).resolve())
            clip = Clip(file, (*range(len(part)), *last), part.name.removeprefix("/"))
            faults += [(f"data/{name}", fault) for fault in named_twice(cameras, {_camera(film): clip})]
            cameras[_camera(film)] = clip
    actions = group.get("actions")
    if actions is not None and not _is_table(actions):
        faults.append((f"data/{name}", f"actions must be numbers [T, a], got {_shape(actions)}"))
    steps = numbered("action", actions) if _is_table(actions) and len(actions) else {}
    return Piece(name, states, steps or None, cameras=cameras)


def _shape(entry: Any) -> list[int]:
    import h5py

    return list(entry.shape or ()) if isinstance(entry, h5py.Dataset) else []


def _number(name: str) -> tuple[int, str]:
    digits = re.search(r"\d+$", name)
    return (int(digits[0]) if digits else -1, name)


def _is_table(entry: Any) -> bool:
    return len(_shape(entry)) in (1, 2) and entry.dtype.kind in "fiub" and not _is_compressed(entry)


def _is_compressed(entry: Any) -> bool:
    """Checks whether every row is the content of an image file."""
    if len(_shape(entry)) not in (1, 2) or not len(entry) or entry.dtype.kind not in "uOSV":
        return False
    return np.asarray(entry[0]).tobytes().startswith(MAGIC)


def _control_frequency(text: Any) -> float | None:
    try:
        return declared_rate(json.loads(text)["env_kwargs"]["control_freq"])
    except (TypeError, ValueError, KeyError):
        return None
