# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes recordings as NumPy archives, or as a LeRobot data set (format 3.0) with or without camera frames."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.lerobot import ACTION, EPISODE, FRAME, STATE
from torchrl_koap.data.formats.parquet import import_pyarrow
from torchrl_koap.data.formats.recordings import Recordings, resolves_coarsely
from torchrl_koap.files import DataError, option, replacing_file

_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK = 1000  # files per folder
_INDEX = {  # LeRobot reads tasks by pandas and finds their descriptions in its index
    "index_columns": ["task"],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": number, "metadata": None}
        for name, kind, number in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
}


def write_npz(recordings: Recordings, out: Path) -> None:
    """Writes a folder of ``*.npz`` files, one per trajectory, named by its number and source."""
    out.mkdir(parents=True)
    digits = len(str(len(recordings.states)))
    about: dict[str, Any] = {"state_names": recordings.state_names, "action_names": recordings.action_names}
    if recordings.control_hz is not None:
        about["control_hz"] = recordings.control_hz
    for index, (states, actions) in enumerate(zip(recordings.states, recordings.actions, strict=True)):
        labelled = {} if np.isnan(actions).all() else {"actions": actions}
        source = re.sub(r"\W+", "_", recordings.sources[index]).strip("_")[-100:]  # of up to 255 letters
        name = f"trajectory_{index:0{digits}}" + (f"_{source}" if source != str(index) else "")
        np.savez(out / f"{name}.npz", states=states, **labelled, **about)


def write_lerobot(recordings: Recordings, out: Path) -> None:
    """Writes a LeRobot data set, in float64 if float32 resolves a column too coarsely. The rate must be known."""
    if recordings.control_hz is None:
        raise DataError(out, f"the rate is not known: pass {option('control_hz')}")
    states, actions = recordings.state_names, recordings.action_names
    coarse = any(_is_coarse(np.concatenate(rows)) for rows in (recordings.states, recordings.actions))
    dtype = "float64" if coarse else "float32"
    writer = LeRobotWriter(out, fps=recordings.control_hz, state_names=states, action_names=actions, dtype=dtype)
    for frames, steps in zip(recordings.states, recordings.actions, strict=True):
        writer.add(frames, steps)
    writer.close()


def _is_coarse(rows: np.ndarray) -> bool:
    """Returns whether float32 rounds a column of ``[N, d]`` by more than 1e-5 of its range."""
    known = rows[np.isfinite(rows).all(-1)]
    if not len(known):
        return False
    return bool(resolves_coarsely(known.min(0), known.max(0), np.float32).any())


class LeRobotWriter:
    """Writes a LeRobot data set episode by episode; :meth:`close` completes it.

    ``state_names`` are the columns of ``observation.state``, ``action_names`` those of ``action``, empty without
    actions. Frames become the feature ``camera``. ``embodiment`` names the demonstrator, ``task`` describes the task.
    Numbers are stored as ``dtype``.

    Raises:
        FileExistsError: if the folder is not empty.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        fps: float,
        state_names: Sequence[str],
        action_names: Sequence[str] = (),
        camera: str | None = None,
        embodiment: str | None = None,
        task: str = "task",
        dtype: str = "float32",
    ):
        self._pyarrow, self._folder = import_pyarrow(), Path(folder)
        if self._folder.exists() and any(self._folder.iterdir()):
            raise FileExistsError(f"{self._folder} is not empty; choose another folder")
        self._fps, self._camera, self._embodiment, self._task, self._dtype = float(fps), camera, embodiment, task, dtype
        self._names = {STATE: list(state_names)} | ({ACTION: list(action_names)} if action_names else {})
        self._shape: list[int] = []
        self._lengths: list[int] = []

    def add(self, states: np.ndarray, actions: np.ndarray | None = None, *, frames: np.ndarray | None = None) -> None:
        """Writes an episode of states ``[T + 1, d]``, actions ``[T, a]`` and camera frames uint8 ``[T + 1, H, W, 3]``.

        LeRobot stores an action per row, so the last frame repeats the last action.
        """
        number, numbers = len(self._lengths), np.arange(len(states))
        columns: dict[str, Any] = {STATE: states}
        if ACTION in self._names and actions is not None:
            columns[ACTION] = np.concatenate([actions, actions[-1:]])
        columns = {name: self._vectors(values) for name, values in columns.items()}
        if self._camera is not None and frames is not None:
            self._shape = list(frames.shape[1:])
            kind = self._pyarrow.struct([("bytes", self._pyarrow.binary()), ("path", self._pyarrow.string())])
            cells = [{"bytes": encode_png(frame), "path": None} for frame in frames]
            columns[self._camera] = self._pyarrow.array(cells, type=kind)
        columns |= {
            "timestamp": (numbers / self._fps).astype(np.float32),
            FRAME: numbers,
            EPISODE: np.full(len(states), number),
            "index": sum(self._lengths) + numbers,
            "task_index": np.zeros(len(states), dtype=np.int64),
        }
        self._write(_DATA.format(chunk_index=number // _CHUNK, file_index=number % _CHUNK), columns)
        self._lengths.append(len(states))

    def close(self) -> Path:
        """Writes the description, which completes the data set; returns the folder."""
        lengths = np.array(self._lengths)
        ends, files = lengths.cumsum(), np.arange(len(lengths))
        listed = {
            EPISODE: files,
            "tasks": [[self._task]] * len(lengths),
            "length": lengths,
            "data/chunk_index": files // _CHUNK,
            "data/file_index": files % _CHUNK,
            "dataset_from_index": ends - lengths,
            "dataset_to_index": ends,
        }
        self._write("meta/episodes/chunk-000/file-000.parquet", listed)
        tasks = {"task_index": np.zeros(1, dtype=np.int64), "task": [self._task]}
        self._write("meta/tasks.parquet", tasks, {"pandas": json.dumps(_INDEX)})
        single = {"shape": [1], "names": None}
        features: dict[str, Any] = {
            name: {"dtype": self._dtype, "shape": [len(columns)], "names": columns}
            for name, columns in self._names.items()
        }
        if self._camera is not None:
            features[self._camera] = {"dtype": "image", "shape": self._shape, "names": ["height", "width", "channel"]}
        features |= {name: {"dtype": "int64", **single} for name in (EPISODE, FRAME, "index", "task_index")}
        info = {
            "codebase_version": "v3.0",
            "robot_type": self._embodiment,
            "fps": int(self._fps) if self._fps.is_integer() else self._fps,
            "total_episodes": len(lengths),
            "total_frames": int(lengths.sum()),
            "total_tasks": 1,
            "chunks_size": _CHUNK,
            "splits": {"train": f"0:{len(lengths)}"},
            "data_path": _DATA,
            "video_path": None,
            "features": features | {"timestamp": {"dtype": "float32", **single}},
        }
        with replacing_file(self._folder / "meta" / "info.json") as aside:
            aside.write_text(json.dumps(info, indent=2) + "\n")
        return self._folder

    def _vectors(self, values: np.ndarray) -> Any:
        flat = self._pyarrow.array(np.ascontiguousarray(values, dtype=self._dtype).reshape(-1))
        return self._pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])

    def _write(self, place: str, columns: dict[str, Any], about: dict[str, str] | None = None) -> None:
        with replacing_file(self._folder / place) as aside:
            self._pyarrow.parquet.write_table(self._pyarrow.table(columns, metadata=about), aside)


def encode_png(frame: np.ndarray) -> bytes:
    """Encodes an image uint8 ``[H, W, 3]`` as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()
