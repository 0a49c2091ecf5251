# This source code is licensed under the MIT license found in the LICENSE file.
"""References to camera frames: ``koap convert`` stores where they are, ``koap embed`` reads them.

::

    recordings/run_000.npz              a trajectory, and beside it a folder of the same name with its cameras:
    recordings/run_000/top/000000.png   an image per row (PNG or JPEG), names end in numbers, or
    recordings/run_000/top.npy          uint8 [T, H, W, 3]
    recordings/run_000/top_times.npy    optional, in s on the clock of the rows: a row takes the nearest frame

HDF5 files hold ``[T, H, W, 3]``, or a JPEG or PNG file per row, beside the numbers. LeRobot data sets hold images in
parquet, or videos (extra ``video``).
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.clocks import declared_rate
from torchrl_koap.data.formats.parquet import import_pyarrow
from torchrl_koap.data.ted import read_about
from torchrl_koap.files import DataError, dataclass_from_json, read_bytes, some
from torchrl_koap.lookup import import_extra

PICTURES = (".png", ".jpg", ".jpeg")
MAGIC = (b"\xff\xd8\xff", b"\x89PNG")  # first bytes of JPEG and PNG files
TIMES = "_times.npy"
LATE = 1.5  # largest distance in time of a frame from its row, in median steps of the camera's clock


@dataclass(frozen=True)
class Clip:
    """Reference to the frames of one camera in one trajectory."""

    file: str  # a folder of images, an array (*.npy), an HDF5 file, a parquet file, or a video
    numbers: tuple[int, ...]  # the frame of every row, as numbered in the file
    entry: str = ""  # data set of an HDF5 file, or column of a parquet file
    episode: int = 0  # of a parquet file, which may hold several

    def __len__(self) -> int:
        return len(self.numbers)

    def take(self, rows: Sequence[int] | np.ndarray) -> Clip:
        """Selects the frames of some rows."""
        return replace(self, numbers=tuple(self.numbers[row] for row in rows))

    def read(self, size: Sequence[int] | None = None) -> Iterator[np.ndarray]:
        """Yields the frames, uint8 ``[H, W, 3]``.

        Args:
            size (sequence of int, optional): required height and width. Default: those of the first frame.

        Raises:
            ValueError: if a frame is missing, damaged, or has another size or type; the message begins with it.
            RuntimeError: if an extra for reading them is missing.
        """
        suffix = Path(self.file).suffix.lower()
        read = _READERS.get("folder" if Path(self.file).is_dir() else suffix, _video)
        if not Path(self.file).exists():
            raise ValueError(f"frame {self.numbers[0]}: {self.file} is missing: convert the data again")
        for number, frame in zip(self.numbers, read(self), strict=True):
            fault = fault_of(frame, size)
            if fault is not None:
                raise ValueError(f"frame {number} {fault}")
            size = frame.shape[:2]
            yield frame


@dataclass(frozen=True)
class _Notes:
    """What the notes of a data set say about frames."""

    cameras: dict[str, tuple[Clip, ...]] = field(default_factory=dict)


def stored_clips(folder: Path) -> dict[str, tuple[Clip, ...]]:
    """Reads the references in the notes of a data set, by camera for every trajectory; a DataError names a fault."""
    try:
        return dataclass_from_json(_Notes, {"cameras": read_about(folder)["notes"].get("cameras", {})}).cameras
    except ValueError as error:
        raise DataError(folder, f"the notes in its about.json are damaged: {error}") from error


def fault_of(frame: np.ndarray, size: Sequence[int] | None = None) -> str | None:
    """Returns a fault of an image and its remedy; None if it is uint8 ``[H, W, 3]`` with the size (H, W)."""
    shape = list(frame.shape)
    if len(shape) != 3 or shape[2] != 3:
        said = "save one image as RGB, the three colours last (depth maps are not used)"
        return f"has shape {shape}, wanted [H, W, 3]: {said}"
    if frame.dtype != np.uint8:
        return f"is {frame.dtype}, wanted uint8 in 0 to 255: scale and round it"
    if size is not None and tuple(shape[:2]) != tuple(size):
        height, width = size
        return f"is {shape[0]} x {shape[1]}, the camera's others are {height} x {width}: resize them alike"
    return None


def _folder(clip: Clip) -> Iterator[np.ndarray]:
    files = _numbered(Path(clip.file))
    for number in clip.numbers:
        if number not in files:
            raise ValueError(f"frame {number} is missing in {clip.file}")
        yield _decode(read_bytes(files[number]), f"{number} ({files[number].name})")


def _decode(content: bytes, what: object) -> np.ndarray:
    from PIL import Image

    try:
        image = Image.open(io.BytesIO(content))
        return np.asarray(image.convert("RGB") if image.mode == "P" else image)
    except Exception as error:  # damaged images may raise any exception
        said = str(error).partition(" <")[0]  # Pillow adds the address of the bytes
        raise ValueError(f"frame {what} is no readable image: {said}") from None


def _array(clip: Clip) -> Iterator[np.ndarray]:
    frames = _load(Path(clip.file))
    for number in clip.numbers:
        if number >= len(frames):
            raise ValueError(f"frame {number} is missing: {clip.file} has {len(frames)}")
        yield frames[number]


def _load(file: Path) -> np.ndarray:
    """Opens an array ``[T, ...]`` as a memory map."""
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{file} holds no array of numbers: save it by numpy.save") from error
    if array.ndim == 0:
        raise ValueError(f"{file} holds a single number, wanted one entry per frame")
    return array


def _hdf5(clip: Clip) -> Iterator[np.ndarray]:
    import h5py

    with h5py.File(clip.file, "r") as stream:
        frames = stream[clip.entry]
        following = stream.get(clip.entry.replace("/obs/", "/next_obs/")) if "/obs/" in clip.entry else None
        held = len(frames) + (following is not None)  # number T is the last frame of next_obs
        for number in clip.numbers:
            if number >= held:
                raise ValueError(f"frame {number} is missing: {clip.file} has {held}")
            frame = frames[number] if number < len(frames) else following[-1]
            yield frame if frames.ndim == 4 else _decode(np.asarray(frame).tobytes(), number)


def _parquet(clip: Clip) -> Iterator[np.ndarray]:
    read, filters = import_pyarrow().parquet, [("episode_index", "=", clip.episode)]
    if clip.entry not in read.read_schema(clip.file).names:
        raise ValueError(f"frame {clip.numbers[0]} is missing: {clip.file} has no column {clip.entry!r}")
    table = read.read_table(clip.file, columns=["frame_index", clip.entry], filters=filters)
    cells = dict(zip(table["frame_index"].to_pylist(), table[clip.entry].to_pylist(), strict=True))
    for number in clip.numbers:
        content = cells.get(number)
        content = content.get("bytes") if isinstance(content, dict) else None
        if not isinstance(content, bytes):
            raise ValueError(f"frame {number} is missing: column {clip.entry!r} has no image in its row")
        yield _decode(content, number)


def _video(clip: Clip) -> Iterator[np.ndarray]:
    """Decodes frames by presentation time, from the key frame before the first one."""
    av = import_extra("av", "video", "videos are read with")
    try:
        with av.open(clip.file) as container:
            yield from _shown(clip, container, container.streams.video[0])
    except (av.FFmpegError, IndexError) as error:
        raise ValueError(
            f"frame {clip.numbers[0]}: PyAV cannot decode {clip.file} ({error}): re-encode it, for example by ffmpeg -i"
            " OLD -c:v libx264 NEW.mp4"
        ) from error


def _shown(clip: Clip, container: Any, stream: Any) -> Iterator[np.ndarray]:
    rate, base = float(stream.average_rate), stream.time_base
    container.seek(int(min(clip.numbers) / rate / base), stream=stream)
    coming = ((round(float(frame.pts * base) * rate), frame) for frame in container.decode(stream))
    place, frame = next(coming, (-1, None))
    for number in clip.numbers:
        while frame is not None and place < number:
            place, frame = next(coming, (place, None))
        if frame is None:
            raise ValueError(f"frame {number} is missing: {clip.file} ends with frame {place}")
        yield frame.to_ndarray(format="rgb24")


_READERS = {"folder": _folder, ".npy": _array, ".hdf5": _hdf5, ".h5": _hdf5, ".parquet": _parquet}


def _numbered(folder: Path) -> dict[int, Path]:
    """Returns the images of a folder by the number at the end of their names."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in PICTURES:
            digits = re.search(r"\d+$", path.stem)
            if digits is None or int(digits[0]) in found:
                raise ValueError(f"{path} must end in a unique number")
            found[int(digits[0])] = path
    return found


def clips_beside(file: Path, clock: np.ndarray | None) -> dict[str, Clip]:
    """Finds the cameras of a table in the folder of the same name; ``clock`` is the time of every row in s.

    Raises:
        ValueError: if frames are missing or their times cannot be used; the message names the camera.
    """
    folder = file.with_suffix("")
    found: dict[str, Clip] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and (pictures := _numbered(path)):
            name, held = path.name, sorted(pictures)
        elif path.suffix == ".npy" and not path.name.endswith(TIMES):
            name, held = path.stem, list(range(len(_load(path))))
        else:
            continue
        times = folder / f"{name}{TIMES}"
        if times.is_file():
            stamps = _load(times)
            if clock is None or stamps.shape != (len(held),):
                got = "no clock in the table" if clock is None else f"times {list(stamps.shape)}"
                raise ValueError(f"camera {name!r}: {times.name} needs {len(held)} times and a clock, got {got}")
            held = [held[index] for index in _nearest(stamps, clock, name)]
        elif held != list(range(held[0], held[0] + len(held))):
            absent = sorted({*range(held[0], held[-1])} - {*held})
            raise ValueError(
                f"camera {name!r}: frame {some(absent)} is missing: give the times of the others in {times.name}"
            )
        if name in found:
            raise ValueError(f"camera {name!r} is there twice, as {Path(found[name].file).name} and {path.name}")
        found[name] = Clip(str(path.resolve()), tuple(held))
    return found


def _nearest(stamps: np.ndarray, clock: np.ndarray, camera: str) -> np.ndarray:
    """Returns the frame nearest in time to every row."""
    if len(stamps) < 2:  # no step, in which a frame could be late
        if len(clock) == len(stamps):  # too short a recording, left out later
            return np.arange(len(stamps))
        raise ValueError(f"camera {camera!r}: wanted two or more frames for {len(clock)} rows, got {len(stamps)}")
    if not (np.diff(stamps) >= 0).all():
        raise ValueError(f"camera {camera!r}: its times do not increase, or are missing")
    after = np.searchsorted(stamps, clock).clip(1, len(stamps) - 1)
    nearest = np.where(clock - stamps[after - 1] <= stamps[after] - clock, after - 1, after)
    off, most = np.abs(stamps[nearest] - clock), LATE * float(np.median(np.diff(stamps)))
    if not off.max() <= most:  # NaN where the row has no time
        row = int(off.argmax())
        raise ValueError(
            f"camera {camera!r}: no frame for row {row} at {clock[row]:.4g} s, the nearest is {off[row]:.3g} s away"
        )
    return nearest


def lerobot_clips(
    root: str | Path, info: Mapping[str, Any], cameras: Mapping[str, str], rows: Mapping[int, Mapping[str, Any]]
) -> dict[int, dict[str, Clip]]:
    """Returns references to the camera frames of every episode of a LeRobot data set.

    A camera whose videos are missing or have no rate is left out. ``cameras`` maps features to the cameras' names.
    ``rows`` holds for every episode its ``file``, its ``frame_index`` ``[T]`` and optionally ``timestamp`` ``[T, 1]``.
    """
    found: dict[int, dict[str, Clip]] = {number: {} for number in rows}
    fps = declared_rate(info.get("fps"))
    for camera, name in cameras.items():
        video = info["features"][camera].get("dtype") == "video"
        begins = _video_starts(Path(root), camera) if video else {}
        for number, columns in rows.items():
            if not video:
                counted = tuple(columns["frame_index"].astype(int).tolist())
                found[number][name] = Clip(str(Path(columns["file"]).resolve()), counted, camera, number)
                continue
            size = int(info.get("chunks_size") or 1000)
            names = {"video_key": camera, "episode_index": number, "episode_chunk": number // size}
            chunk, file, start = begins.get(number, (0, 0, 0.0))
            try:
                place = str(info.get("video_path")).format(**names, chunk_index=chunk, file_index=file)
            except (KeyError, IndexError, ValueError) as error:
                raise DataError(root, f"info.json: 'video_path' has an unknown part: {error}") from error
            path = Path(root) / place
            if fps is not None and path.is_file():
                stamps = columns.get("timestamp", np.full((1, 1), np.nan))[:, 0]
                shown = stamps * fps if np.isfinite(stamps).all() else columns["frame_index"]
                numbers = np.round(shown + start * fps).astype(int)
                found[number][name] = Clip(str(path.resolve()), tuple(numbers.tolist()))
    return found


def _video_starts(root: Path, camera: str) -> dict[int, tuple[int, int, float]]:
    """Returns chunk, file and start time (s) of every episode's video; empty before format 3.0."""
    columns = [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    found = {}
    for file in (root / "meta/episodes").rglob("[!.]*.parquet"):
        table = import_pyarrow().parquet.read_table(file)
        if set(columns) <= set(table.column_names):
            for row in table.select(["episode_index", *columns]).to_pylist():
                found[row["episode_index"]] = tuple(row[column] for column in columns)
    return found
