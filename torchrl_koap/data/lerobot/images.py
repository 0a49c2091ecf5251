# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations with camera frames as a LeRobot data set (v2.1, pictures as PNG in parquet), written as they come."""

from __future__ import annotations

import importlib.util
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.files import check_file, read_bytes, replacing_file

CAMERA = "observation.images.third_person"
EMBODIMENT = "embodiment"
_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
LOCK = ".lock"  # a file that may lie in the folder of a recording
_UNFINISHED = "unfinished.json"  # while recording: what was asked for, and an account of every episode so far


class ImageDataError(ValueError):
    """A data set of camera frames that is unfinished, of another size or layout, or mixes embodiments unsaid."""


@dataclass(frozen=True)
class ImageEpisode:
    """What a camera saw in one demonstration.

    Args:
        frames (np.ndarray): uint8 ``[T + 1, H, W, 3]``.
        state (np.ndarray): what else is known ``[T + 1, d]``.
        action (np.ndarray, optional): ``[T, act]``; None for an embodiment without.
        embodiment (str): whose demonstration it is.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data.lerobot.images import ImageEpisode
        >>> len(ImageEpisode(np.zeros((5, 8, 8, 3), np.uint8), np.zeros((5, 3)), None, "hand"))
        4
    """

    frames: np.ndarray
    state: np.ndarray
    action: np.ndarray | None
    embodiment: str

    def __len__(self) -> int:
        return len(self.frames) - 1


def _pyarrow():
    if importlib.util.find_spec("pyarrow") is None:
        raise RuntimeError("data sets with pictures need an extra: pip install 'torchrl_koap[lerobot]'")
    import pyarrow
    import pyarrow.parquet

    return pyarrow


class ImageEpisodeWriter:
    """Writes episodes one after the other; the data set is finished by :meth:`close`.

    Args:
        folder (str or Path): folder to create; one that holds an unfinished recording of the same is gone on with.
        fps (float): frames per second.
        state_names (sequence of str): columns of ``observation.state``.
        action_names (sequence of str): columns of ``action``; empty for an embodiment without.
        embodiment (str): whose demonstrations they are.
        task (str): what is done, in words.
        request (dict, optional): what tells this recording from others, as JSON can hold it. Default: the arguments
            above.

    Attributes:
        accounts (list of dict): what :meth:`add` was told about every episode so far, those of an interrupted recording
            included.
        num_frames (int): their frames.

    Raises:
        FileExistsError: if the folder holds a finished data set, an unfinished recording of another request, or
            anything else.
        ImageDataError: if the account of an unfinished recording is damaged.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_koap.data.lerobot.images import ImageEpisode, ImageEpisodeWriter, read_image_episodes
        >>> about = {"state_names": ["x"], "action_names": [], "embodiment": "hand", "task": "wave"}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     writer = ImageEpisodeWriter(folder, fps=10, **about)
        ...     writer.add(ImageEpisode(np.zeros((4, 8, 8, 3), np.uint8), np.zeros((4, 1)), None, "hand"))
        ...     read_image_episodes(writer.close())[0].frames.shape
        (4, 8, 8, 3)
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        fps: float,
        state_names: Sequence[str],
        action_names: Sequence[str],
        embodiment: str,
        task: str,
        request: dict[str, Any] | None = None,
    ):
        self.folder = Path(folder)
        self._fps, self._names, self._actions = fps, list(state_names), list(action_names)
        self._embodiment, self._task = embodiment, task
        own = {"fps": fps, "states": self._names, "actions": self._actions, "embodiment": embodiment, "task": task}
        self._request = own if request is None else request
        if (self.folder / "meta" / "info.json").exists():
            raise FileExistsError(f"{self.folder} holds a data set already; choose another folder")
        _pyarrow()
        self._shape: list[int] = []
        self._lengths: list[int] = []
        self.num_frames = 0
        self.accounts: list[dict[str, Any]] = []
        self._go_on()

    def _go_on(self) -> None:
        """Takes over what an interrupted recording of the same left."""
        path = self.folder / _UNFINISHED
        if not path.exists():
            if self.folder.exists() and any(entry.name != LOCK for entry in self.folder.iterdir()):
                raise FileExistsError(f"{self.folder} is not empty; choose another folder")
            return
        try:
            known = json.loads(read_bytes(path))
            asked = known["request"]
            episodes = [(each["rows"], each["shape"], each["about"]) for each in known["episodes"]]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ImageDataError(f"{path} cannot be read: {error}") from error
        if asked != self._request:
            raise FileExistsError(
                f"{self.folder} holds an interrupted recording of {json.dumps(asked)}, not of"
                f" {json.dumps(self._request)}: ask for the same to go on, or remove it"
            )
        for episode in episodes:
            self._count(*episode)

    def _count(self, rows: int, shape: list[int], account: dict[str, Any]) -> None:
        self._shape = shape
        self._lengths.append(rows)
        self.num_frames += rows
        self.accounts.append(account)

    def add(self, episode: ImageEpisode, **account: Any) -> None:
        """Writes an episode; its action after the last frame repeats the one before, as LeRobot has a row per frame.

        Args:
            episode (ImageEpisode): the episode.
            **account: what shall be known about it if the recording is interrupted, as JSON can hold it.
        """
        pyarrow = _pyarrow()
        if not self.accounts:
            self._note()
        number, rows = len(self._lengths), len(episode.frames)
        frames = np.arange(rows)
        columns: dict[str, Any] = {
            CAMERA: pyarrow.array(
                [{"bytes": png, "path": None} for png in map(encode_png, episode.frames)],
                type=pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())]),
            ),
            "observation.state": _matrix(pyarrow, episode.state),
        }
        if episode.action is not None:
            columns["action"] = _matrix(pyarrow, np.concatenate([episode.action, episode.action[-1:]]))
        columns |= {
            "timestamp": (frames / self._fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(rows, number),
            "index": self.num_frames + frames,
            "task_index": np.zeros(rows, dtype=np.int64),
        }
        with replacing_file(self.folder / _DATA.format(episode_chunk=0, episode_index=number)) as aside:
            pyarrow.parquet.write_table(pyarrow.table(columns), aside)
        self._count(rows, list(episode.frames.shape[1:]), account)
        self._note()

    def _note(self) -> None:
        """Writes down what there is, for a recording that is interrupted."""
        counted = zip(self._lengths, self.accounts, strict=True)
        episodes = [{"rows": rows, "shape": self._shape, "about": account} for rows, account in counted]
        with replacing_file(self.folder / _UNFINISHED) as aside:
            aside.write_text(json.dumps({"request": self._request, "episodes": episodes}))

    def close(self) -> Path:
        """Writes the description, which makes the data set a finished one."""
        meta = self.folder / "meta"
        meta.mkdir(parents=True, exist_ok=True)
        lines = [{"episode_index": i, "tasks": [self._task], "length": n} for i, n in enumerate(self._lengths)]
        (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": self._task}) + "\n")
        single = {"shape": [1], "names": None}
        numbers = ("frame_index", "episode_index", "index", "task_index")
        features: dict[str, Any] = {
            CAMERA: {"dtype": "image", "shape": self._shape, "names": ["height", "width", "channel"]},
            "observation.state": {"dtype": "float32", "shape": [len(self._names)], "names": self._names},
            **(
                {"action": {"dtype": "float32", "shape": [len(self._actions)], "names": self._actions}}
                if self._actions
                else {}
            ),
            "timestamp": {"dtype": "float32", **single},
            **{name: {"dtype": "int64", **single} for name in numbers},
        }
        info = {
            "codebase_version": "v2.1",
            "robot_type": self._embodiment,
            EMBODIMENT: self._embodiment,
            "fps": int(self._fps) if float(self._fps).is_integer() else self._fps,
            "total_episodes": len(self._lengths),
            "total_frames": self.num_frames,
            "total_tasks": 1,
            "total_videos": 0,
            "total_chunks": 1,
            "chunks_size": 1000,
            "splits": {"train": f"0:{len(self._lengths)}"},
            "data_path": _DATA,
            "video_path": None,
            "features": features,
        }
        with replacing_file(meta / "info.json") as aside:
            aside.write_text(json.dumps(info, indent=2) + "\n")
        (self.folder / _UNFINISHED).unlink(missing_ok=True)
        return self.folder


def _matrix(pyarrow, values: np.ndarray):
    values = np.ascontiguousarray(values, dtype=np.float32)
    return pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.reshape(-1)), values.shape[1])


def encode_png(frame: np.ndarray) -> bytes:
    """A picture uint8 ``[H, W, 3]`` as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def read_image_info(folder: str | Path) -> dict[str, Any]:
    """Description of a data set with camera frames.

    Raises:
        ImageDataError: if there is none, it is damaged, or it has no camera.
    """
    path = Path(folder) / "meta" / "info.json"
    if not path.is_file():
        raise ImageDataError(f"{folder} holds no finished data set (meta/info.json is missing); `koap demos` makes one")
    try:
        info = json.loads(read_bytes(path))
    except (OSError, ValueError, RecursionError) as error:
        raise ImageDataError(f"{path} cannot be read: {error}") from error
    if not isinstance(info, dict) or not isinstance(info.get("features", {}), dict):
        raise ImageDataError(f"{path} is no description of a data set: wanted an object whose features are one")
    total = info.get("total_episodes")
    if type(total) is not int or total < 1:
        raise ImageDataError(f"{path}: total_episodes must be a whole number >= 1, got {total!r}")
    if CAMERA not in info.get("features", {}):
        raise ImageDataError(f"{folder} has no camera {CAMERA!r}: there is nothing to embed")
    return info


def read_image_episodes(
    folder: str | Path, *, episodes: int | None = None, embodiment: str | None = None
) -> list[ImageEpisode]:
    """Episodes with their frames.

    Args:
        folder (str or Path): a data set that :class:`ImageEpisodeWriter` wrote.

    Keyword Args:
        episodes (int, optional): only so many, from the first. Default: all.
        embodiment (str, optional): refuse demonstrations of another one.

    Raises:
        ImageDataError: if the folder holds no such data set, too few episodes, or those of another embodiment; or if
            an episode is damaged.
    """
    info = read_image_info(folder)
    own, total = info.get(EMBODIMENT, "unknown"), info["total_episodes"]
    if embodiment is not None and own != embodiment:
        raise ImageDataError(f"{folder} holds demonstrations of embodiment {own!r}, wanted {embodiment!r}")
    if episodes is not None and not 1 <= episodes <= total:
        raise ImageDataError(f"{folder} holds {total} episodes, asked for {episodes}")
    found = []
    for number in range(total if episodes is None else episodes):
        file = Path(folder) / _DATA.format(episode_chunk=0, episode_index=number)
        try:
            columns = _read_columns(file)
            action = _numbers(columns, "action")[:-1] if "action" in columns else None
            episode = ImageEpisode(_pictures(columns[CAMERA]), _numbers(columns, "observation.state"), action, own)
        except RuntimeError:  # no pyarrow
            raise
        except Exception as error:  # a damaged file can be wrong in any way
            raise ImageDataError(f"{file} cannot be used: {error}") from error
        found.append(episode)
    return found


def _read_columns(file: Path) -> dict[str, list]:
    pyarrow = _pyarrow()
    check_file(file)
    table = pyarrow.parquet.read_table(file)
    missing = [name for name in (CAMERA, "observation.state") if name not in table.column_names]
    if missing:
        raise ValueError(f"column {missing[0]!r} is missing")
    if len(table) < 2:
        raise ValueError(f"{len(table)} row(s): an episode has two frames at least")
    return {name: table[name].to_pylist() for name in table.column_names if not name.endswith("index")}


def _numbers(columns: dict[str, list], name: str) -> np.ndarray:
    """A column of vectors ``[T, d]``."""
    try:
        values = np.array(columns[name], dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"column {name!r} holds no vectors of one size: {error}") from None
    if values.ndim != 2:
        raise ValueError(f"column {name!r} holds no vectors: wanted [T, d], got shape {list(values.shape)}")
    return values


def _pictures(cells: list) -> np.ndarray:
    """Frames uint8 ``[T, H, W, 3]``."""
    from PIL import Image

    frames = []
    for row, cell in enumerate(cells):
        content = cell.get("bytes") if isinstance(cell, dict) else None
        if not isinstance(content, bytes):
            raise ValueError(f"column {CAMERA!r} has no picture in row {row}")
        try:
            frames.append(np.asarray(Image.open(io.BytesIO(content))))
        except Exception as error:  # what a damaged picture makes of a decoder
            raise ValueError(f"column {CAMERA!r} has a damaged picture in row {row}: {error}") from None
    shapes = sorted({frame.shape for frame in frames})
    if len(shapes) > 1 or len(shapes[0]) != 3 or shapes[0][-1] != 3:
        raise ValueError(f"column {CAMERA!r} has pictures of shapes {shapes}: wanted one [H, W, 3]")
    return np.stack(frames)
