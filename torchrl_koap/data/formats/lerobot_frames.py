# This source code is licensed under the MIT license found in the LICENSE file.
"""Camera frames of a LeRobot data set: PNG in its parquet files, or videos (extra ``video``)."""

from __future__ import annotations

import importlib.util
import io
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.lerobot import ACTION, IMAGES, STATE, is_lerobot, read_info, read_rows
from torchrl_koap.files import DataError

EMBODIMENT = "embodiment"  # an entry of info.json that LeRobot itself has nothing like


@dataclass(frozen=True)
class ImageEpisode:
    """What a camera saw in one demonstration.

    Args:
        frames (np.ndarray): uint8 ``[T + 1, H, W, 3]``.
        state (np.ndarray): what else is known ``[T + 1, d]``.
        action (np.ndarray, optional): ``[T, act]``; None for an embodiment without.
        embodiment (str): who demonstrates.
    """

    frames: np.ndarray
    state: np.ndarray
    action: np.ndarray | None
    embodiment: str

    def __len__(self) -> int:
        return len(self.frames) - 1


def read_image_episodes(
    folder: str | Path, *, camera: str | None = None, episodes: int | None = None, embodiment: str | None = None
) -> list[ImageEpisode]:
    """Reads episodes of a LeRobot data set with their frames.

    Args:
        folder (str or Path): the data set, such as ``koap demos --embodiment`` writes.
        camera (str, optional): feature of the frames. Default: the only camera.
        episodes (int, optional): only so many, from the first. Default: all.
        embodiment (str, optional): refuse demonstrations of another one.
    """
    if not is_lerobot(folder):
        raise DataError(folder, "it holds no finished data set (meta/info.json is missing); `koap demos` makes one")
    info = read_info(folder)
    own, total = info.get(EMBODIMENT, "unknown"), info.get("total_episodes")
    if type(total) is not int or total < 1:
        raise DataError(Path(folder) / "meta/info.json", f"total_episodes must be a whole number >= 1, got {total!r}")
    if embodiment not in (None, own):
        raise DataError(folder, f"it holds demonstrations of embodiment {own!r}, wanted {embodiment!r}")
    if episodes is not None and not 1 <= episodes <= total:
        raise DataError(folder, f"it holds {total} episodes, asked for {episodes}")
    camera = _camera(folder, info, camera)
    video = info["features"][camera].get("dtype") == "video"
    rows = read_rows(folder, [STATE], pictures=() if video else (camera,))
    found = []
    for number, columns in list(rows.items())[:episodes]:
        state, action = columns[STATE], columns.get(ACTION)
        try:
            if len(state) < 2:
                raise ValueError("1 row: an episode has two frames at least")
            if not np.isfinite(state).all():
                raise ValueError(f"column {STATE!r} is empty, NaN or infinite in some rows")
            if video:
                frames = _from_video(Path(folder), info, camera, number, len(state))
            else:
                frames = _from_cells(columns[camera], camera)
        except (ValueError, OSError) as error:
            raise DataError(folder, f"episode {number}: {error}") from error
        label = None if action is None else action[:-1].astype(np.float32)
        found.append(ImageEpisode(frames, state.astype(np.float32), label, own))
    return found


def _camera(folder: str | Path, info: dict[str, Any], wanted: str | None) -> str:
    cameras = [name for name, feature in info["features"].items() if feature.get("dtype") in IMAGES]
    if wanted is None and len(cameras) == 1 or wanted in cameras:
        return wanted or cameras[0]
    there = ", ".join(cameras) or "none"
    asked = "no camera: there is nothing to embed" if not cameras else "several cameras: choose one"
    raise DataError(folder, f"it has {asked if wanted is None else f'no camera {wanted!r}'} (cameras: {there})")


def _from_cells(cells: list, camera: str) -> np.ndarray:
    """Frames uint8 ``[T, H, W, 3]`` of pictures in parquet."""
    from PIL import Image

    frames = []
    for row, cell in enumerate(cells):
        content = cell.get("bytes") if isinstance(cell, dict) else None
        if not isinstance(content, bytes):
            raise ValueError(f"column {camera!r} has no picture in row {row}")
        try:
            frames.append(np.asarray(Image.open(io.BytesIO(content))))
        except Exception as error:  # what a damaged picture makes of a decoder
            raise ValueError(f"column {camera!r} has a damaged picture in row {row}: {error}") from None
    shapes = sorted({frame.shape for frame in frames})
    if len(shapes) > 1 or len(shapes[0]) != 3 or shapes[0][-1] != 3:
        raise ValueError(f"column {camera!r} has pictures of shapes {shapes}: wanted one [H, W, 3]")
    return np.stack(frames)


def _from_video(folder: Path, info: dict, camera: str, number: int, length: int) -> np.ndarray:
    """Frames uint8 ``[T, H, W, 3]`` of a video, of which an episode may be a part (format 3.0)."""
    if importlib.util.find_spec("imageio") is None:
        raise RuntimeError("videos are read with an extra: pip install 'torchrl_koap[video]'")
    import imageio.v3

    size, first = int(info.get("chunks_size") or 1000), 0
    names = {"video_key": camera, "episode_index": number, "episode_chunk": number // size}
    about = _about_video(folder, camera, number)
    if about is not None:  # format 3.0
        names |= {"chunk_index": about[0], "file_index": about[1]}
        first = round(about[2] * float(info["fps"]))
    path = folder / str(info.get("video_path")).format(**names)
    frames = list(islice(imageio.v3.imiter(path), first, first + length))
    if len(frames) < length:
        raise ValueError(f"{path} has {first + len(frames)} frames, {first + length} are needed")
    return np.stack(frames)[..., :3]


def _about_video(folder: Path, camera: str, number: int) -> tuple[int, int, float] | None:
    """Chunk and number of an episode's video, and where in it the episode begins (s); None before format 3.0."""
    import pyarrow.parquet

    columns = [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    for file in (folder / "meta/episodes").rglob("*.parquet"):
        for row in pyarrow.parquet.read_table(file, columns=["episode_index", *columns]).to_pylist():
            if row["episode_index"] == number:
                return row[columns[0]], row[columns[1]], row[columns[2]]
    return None
