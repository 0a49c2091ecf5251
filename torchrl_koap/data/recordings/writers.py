# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings in other formats: tables, robomimic's HDF5, LeRobot 2.1 and 3.0, Minari, D3IL's raw pickles.

Each writes what its reader reads back: states, actions, which of them are unknown, names of the columns, the rate.
LeRobot holds float32, the others float64. A data set of this library becomes recordings by :func:`recordings_of`.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.recordings.minari import write_minari
from torchrl_koap.data.recordings.recordings import Recordings, RecordingsError, make_recordings
from torchrl_koap.data.ted import load_ted, read_about, read_task
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import Task, get_task

_CHUNK = "chunk-000"


def recordings_of(folder: str | Path) -> Recordings:
    """A data set of this library, written by ``koap demos``, ``koap convert`` or ``save_demonstrations``.

    Args:
        folder (str or Path): the folder that holds ``ted``.

    Returns:
        Recordings: all observation columns, the command included, and the labels that there are.

    Raises:
        TEDError: if the data set is damaged.

    Examples:
        >>> from torchrl_koap.data.recordings.writers import recordings_of
        >>> recordings_of("demos").num_labels  # doctest: +SKIP
        8112
    """
    folder = Path(folder) / "ted"
    data, task = load_ted(folder), stored_task(folder.parent)
    episode = data["episode"].numpy()
    starts = np.flatnonzero(np.diff(episode, prepend=episode[0] - 1))
    ends = [*starts[1:], len(episode)]
    observed, behind = data["observation"].double().numpy(), data["next", "observation"].double().numpy()
    actions = np.where(data["has_action"].numpy(), data["action"].double().numpy(), np.nan)
    spans = list(zip(starts, ends, strict=True))
    return make_recordings(
        [np.concatenate([observed[start:end], behind[end - 1 : end]]) for start, end in spans],
        [actions[start:end] for start, end in spans],
        state_names=task.observation_names,
        action_names=task.action_names,
        sources=[str(episode[start]) for start in starts],
        control_hz=task.control_hz,
        source=str(folder),
    )


def stored_task(folder: str | Path) -> Task:
    """The task of a data set of this library: the one that it holds, or the registered one that it names.

    Args:
        folder (str or Path): the folder that holds ``ted``.

    Raises:
        TEDError: if the data set is damaged.
        ValueError: if nobody registered the task that it names.

    Examples:
        >>> from torchrl_koap.data.recordings.writers import stored_task
        >>> stored_task("demos").name  # doctest: +SKIP
        'avoiding'
    """
    folder = Path(folder) / "ted"
    task = read_task(folder)
    return get_task(read_about(folder)["task"]) if task is None else task


def write_recordings(recordings: Recordings, out: str | Path, kind: str) -> Path:
    """Writes recordings in another format.

    Args:
        recordings (Recordings): what to write; its rate is needed by all formats but tables.
        out (str or Path): file of ``"robomimic"``, ``minari:NAME`` for ``"minari"``, folder of the others; it must not
            exist yet.
        kind (str): a name in ``WRITERS``.

    Returns:
        Path: what was written.

    Raises:
        ValueError: for an unknown format; the message suggests the nearest.
        FileExistsError: if there is something of that name.
        RecordingsError: if the rate is not known.
        RuntimeError: if the format's package is not installed; the message names the extra.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_koap.data.recordings import make_recordings, read_tables
        >>> from torchrl_koap.data.recordings.writers import write_recordings
        >>> recordings = make_recordings([np.zeros((5, 3))], [np.ones((5, 2))], control_hz=30.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     read_tables(write_recordings(recordings, f"{folder}/arm", "npz")).control_hz
        30.0
    """
    write: Callable[[Recordings, Path], None] = lookup(WRITERS, kind, "format")
    out = Path(out)
    if out.exists() and kind != "minari":
        raise FileExistsError(f"{out} exists already; choose another --out")
    if recordings.control_hz is None and kind != "npz":
        raise RecordingsError(str(out), ["the rate is not known: pass control_hz"])
    write(recordings, out)
    return out


def _write_npz(recordings: Recordings, out: Path) -> None:
    out.mkdir(parents=True)
    digits = len(str(len(recordings.states)))
    about: dict[str, Any] = {"state_names": recordings.state_names, "action_names": recordings.action_names}
    if recordings.control_hz is not None:
        about["control_hz"] = recordings.control_hz
    for index, (states, actions) in enumerate(zip(recordings.states, recordings.actions, strict=True)):
        labelled = {} if np.isnan(actions).all() else {"actions": actions}
        np.savez(out / f"trajectory_{index:0{digits}}.npz", states=states, **labelled, **about)


def _write_robomimic(recordings: Recordings, out: Path) -> None:
    if importlib.util.find_spec("h5py") is None:
        raise RuntimeError("HDF5 files are written with an extra: pip install 'torchrl_koap[hdf5]'")
    import h5py

    out.parent.mkdir(parents=True, exist_ok=True)
    arguments = {"env_name": "recordings", "type": 1, "env_kwargs": {"control_freq": recordings.control_hz}}
    with h5py.File(out, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(arguments)
        data.attrs["total"] = sum(map(len, recordings.actions))
        for index, (states, actions) in enumerate(zip(recordings.states, recordings.actions, strict=True)):
            demo = data.create_group(f"demo_{index}")
            demo.attrs["num_samples"] = len(actions)
            for column, name in enumerate(recordings.state_names):
                demo[f"obs/{name}"], demo[f"next_obs/{name}"] = states[:-1, column], states[1:, column]
            if not np.isnan(actions).all():
                demo["actions"] = actions
            demo["rewards"], demo["dones"] = np.zeros(len(actions)), np.arange(len(actions)) == len(actions) - 1


def _write_lerobot_2(recordings: Recordings, out: Path) -> None:
    columns = [_lerobot_columns(recordings, index) for index in range(len(recordings.states))]
    meta = out / "meta"
    for index, rows in enumerate(columns):
        _write_parquet(rows, out / "data" / _CHUNK / f"episode_{index:06d}.parquet")
    meta.mkdir(parents=True)
    lines = [{"episode_index": i, "tasks": ["task"], "length": len(rows["index"])} for i, rows in enumerate(columns)]
    (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "task"}) + "\n")
    _write_info(recordings, meta, "v2.1", "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet")


def _write_lerobot_3(recordings: Recordings, out: Path) -> None:
    columns = [_lerobot_columns(recordings, index) for index in range(len(recordings.states))]
    together = {name: np.concatenate([rows[name] for rows in columns]) for name in columns[0]}
    _write_parquet(together, out / "data" / _CHUNK / "file-000.parquet")
    lengths = np.array([len(rows["index"]) for rows in columns])
    ends, zeros = lengths.cumsum(), np.zeros(len(lengths), dtype=np.int64)
    listed = {
        "episode_index": np.arange(len(lengths)),
        "length": lengths,
        "data/chunk_index": zeros,
        "data/file_index": zeros,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
    }
    _write_parquet(listed, out / "meta" / "episodes" / _CHUNK / "file-000.parquet")
    _write_info(recordings, out / "meta", "v3.0", "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")


def _lerobot_columns(recordings: Recordings, episode: int) -> dict[str, np.ndarray]:
    """Rows of an episode: a frame each, with the action that follows it; behind the last frame it is unknown."""
    states, actions = recordings.states[episode], recordings.actions[episode]
    before = sum(map(len, recordings.states[:episode]))
    frames = np.arange(len(states))
    return {
        "observation.state": states.astype(np.float32),
        "action": np.concatenate([actions, actions[-1:]]).astype(np.float32),
        "episode_index": np.full(len(states), episode),
        "frame_index": frames,
        "timestamp": (frames / recordings.control_hz).astype(np.float32),
        "index": before + frames,
        "task_index": np.zeros(len(states), dtype=np.int64),
    }


def _write_parquet(columns: dict[str, np.ndarray], file: Path) -> None:
    if importlib.util.find_spec("pyarrow") is None:
        raise RuntimeError("LeRobot data sets are written with an extra: pip install 'torchrl_koap[lerobot]'")
    import pyarrow
    import pyarrow.parquet

    file.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        name: pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(value.reshape(-1)), value.shape[1])
        if value.ndim == 2
        else pyarrow.array(value)
        for name, value in columns.items()
    }
    pyarrow.parquet.write_table(pyarrow.table(arrays), file)


def _write_info(recordings: Recordings, meta: Path, version: str, data_path: str) -> None:
    rate = recordings.control_hz
    single = {"shape": [1], "names": None}
    features: dict[str, Any] = {
        "observation.state": _feature(recordings.state_names),
        "action": _feature(recordings.action_names),
        **{name: {"dtype": "int64", **single} for name in ("episode_index", "frame_index", "index", "task_index")},
        "timestamp": {"dtype": "float32", **single},
    }
    info = {
        "codebase_version": version,
        "fps": int(rate) if float(rate).is_integer() else rate,
        "total_episodes": len(recordings.states),
        "total_frames": sum(map(len, recordings.states)),
        "total_tasks": 1,
        "chunks_size": 1000,
        "splits": {"train": f"0:{len(recordings.states)}"},
        "data_path": data_path,
        "video_path": None,
        "features": features,
    }
    (meta / "info.json").write_text(json.dumps(info, indent=2) + "\n")


def _feature(names: tuple[str, ...]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def _write_d3il(recordings: Recordings, out: Path) -> None:
    from torchrl_koap.data.d3il.writing import write_d3il

    write_d3il(recordings, out)


WRITERS: dict[str, Callable[[Recordings, Path], None]] = {
    "npz": _write_npz,
    "robomimic": _write_robomimic,
    "lerobot": _write_lerobot_3,
    "lerobot-2.1": _write_lerobot_2,
    "minari": write_minari,
    "d3il": _write_d3il,
}
