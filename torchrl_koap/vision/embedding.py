# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts data with camera frames to data with embeddings, for ``koap train --dataset``."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_koap.data import flatten_trajectories, read_recordings, save_ted
from torchrl_koap.data.formats import Recordings
from torchrl_koap.data.formats.clocks import UNEVEN
from torchrl_koap.data.ted import CAMERAS, stored_folder, stored_task
from torchrl_koap.files import DataError, option, refuse, replacing_file, some
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import Task
from torchrl_koap.vision.backbones import load_backbone
from torchrl_koap.vision.encoder import BATCH, FrozenImageEncoder, Projection, load_encoder
from torchrl_koap.vision.observer import part_widths

MOST = 4000  # about the most frames that components are fitted to
HELD_OUT = 10  # one trajectory in this many is held out to evaluate them
UNLIKE = 4.0  # multiple of the median distance above which the pictures of a trajectory cause a warning


@dataclass(frozen=True)
class CameraReport:
    """Reports how much of a camera's features its embeddings keep."""

    size: tuple[int, int]  # height and width of its frames
    components: int  # columns of an embedding
    kept: float  # share of the features' variance, on held-out trajectories if there are ten or more

    def __str__(self) -> str:
        return (
            f"{self.size[0]} x {self.size[1]}, {self.components} components keep {self.kept:.1%} of the variance,"
            f" reconstruction error {(1 - self.kept) ** 0.5:.2f} of the spread"
        )


def read_sources(sources: Sequence[str | Path], task: Task | None) -> tuple[Recordings, Task]:
    """Reads data sets with camera frames as one: outputs of ``koap convert``, or any recordings if a task is given.

    The task has columns for the embeddings; by default it is that of the first source with labels. Raises a DataError
    if columns, units or rates of the sources differ, or without task if a source is not converted.
    """
    found: list[Recordings] = []
    units: dict[str, str] = {}
    for source in sources:
        stored = stored_folder(source)
        if stored is None and task is None and Path(source).exists():
            raise DataError(source, "its columns are not described: `koap convert` it, or name its --task")
        width = None if stored is not None or task is None else task.action_dim
        found.append(read_recordings(source, action_dim=width))
        own = {} if stored is None else _units(stored_task(stored), labelled=found[-1].num_labels > 0)
        other = [
            f"{what} is {unit!r}, before {units[what]!r}" for what, unit in own.items() if units.get(what, unit) != unit
        ]
        refuse(source, other)
        units |= own
    joined, telling = join_recordings(found), sources[_first_labelled(found)]
    return joined, task or stored_task(stored_folder(telling) or telling)


def _first_labelled(parts: Sequence[Recordings]) -> int:
    """Returns the number of the first part with labels, which knows names, units and kinds of the actions; else 0."""
    return next((number for number, part in enumerate(parts) if part.num_labels), 0)


def _units(task: Task, *, labelled: bool) -> dict[str, str]:
    """Returns the units that are given, and kinds and targets of actions; nothing about actions without labels."""
    units = {
        f"the unit of column {name!r}": unit
        for name, unit in zip(task.observation_names, task.known_units, strict=True)
    }
    for name, action in task.actions.items() if labelled else ():
        units |= {f"the unit of action {name!r}": action.unit, f"the kind of action {name!r}": action.kind}
        units |= {} if action.column is None else {f"the target of action {name!r}": task.state_names[action.column]}
    return {what: unit for what, unit in units.items() if unit}


def join_recordings(parts: Sequence[Recordings]) -> Recordings:
    """Concatenates recordings with the same columns, with the cameras that all of them have."""
    first = parts[_first_labelled(parts)]
    for other in parts:
        source, both = f"the source of {other.sources[0]}", (other, first)
        if other.state_names != first.state_names or other.actions[0].shape[1] != first.actions[0].shape[1]:
            columns = "; those of the first ".join(", ".join(part.state_names) for part in both)
            raise DataError(source, f"its columns are {columns}")
        if other.action_names != first.action_names and all(part.num_labels for part in both):
            columns = "; those of the first ".join(", ".join(part.action_names) for part in both)
            raise DataError(source, f"its actions are {columns}")
        rates = [part.control_hz for part in both if part.control_hz is not None]
        if rates and max(rates) > (1 + UNEVEN) * min(rates):
            said = f"it has {other.control_hz:g} frames per second, the first {first.control_hz:g}"
            raise DataError(source, f"{said}: convert it with {option('resample')} {first.control_hz:g}")
    shared = [name for name in first.cameras if all(name in other.cameras for other in parts)]
    return replace(
        first,
        states=[states for part in parts for states in part.states],
        actions=[steps for part in parts for steps in part.actions],
        sources=tuple(name for part in parts for name in part.sources),
        cameras={name: [clip for part in parts for clip in part.cameras[name]] for name in shared},
    )


def embed_recordings(
    recordings: Recordings,
    task: Task,
    out: str | Path,
    *,
    cameras: Sequence[str] = (),
    network: str | None = None,
    components: int = 32,
    projection: Projection | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, CameraReport]:
    """Writes recordings with the embeddings of their frames into ``out/ted``, and projections into ``out/cameras``.

    Embeddings fill the part of the task's observation with the camera's name. Without such a part they become further
    columns that are not the robot's. ``out/unfinished`` holds features until the end, so that a repeated call resumes.

    For every camera, or the named ``cameras``, components are fitted to frames of nine trajectories in ten. Their
    number is the width of the task's part, or else ``components``. For a single camera a ``projection`` may be given
    instead. ``progress`` is called with the numbers of frames done and of all frames. Frames that are missing, damaged
    or of another format or size raise a DataError that names camera, trajectory and frame.
    """
    if components < 1:
        raise ValueError(f"{option('components')} must be at least 1, got {components}")
    out, chosen = Path(out), list(cameras) or list(recordings.cameras)
    if not chosen:
        raise DataError(out, "there are no cameras: the data have no frames, or were converted without them")
    for name in chosen:
        lookup(recordings.cameras, name, "camera")
    if projection is not None and len(chosen) > 1:
        raise ValueError(f"a projection fits one camera, got {len(chosen)}: name one of {', '.join(chosen)}")
    given = None if projection is None else load_encoder(projection, network)
    backbone = load_backbone(network) if given is None else given.backbone
    if network is not None and load_backbone(network).digest != backbone.digest:
        cause = "has other weights each time it is made"
        raise ValueError(f"network {network!r} {cause}: load them from a file, or seed them before they are drawn")
    total, done = len(chosen) * sum(map(len, recordings.states)), 0
    embedded: dict[str, list[Tensor]] = {}
    reports = {}
    for name in chosen:
        size = next(_read(recordings, name, 0)).shape[:2]
        encoder = FrozenImageEncoder(backbone, size=size) if given is None else given
        stored = _CameraFeatures(name, recordings, encoder, out / "unfinished")
        for count in stored.embed():
            done += count
            if progress is not None:
                progress(done, total)
        if unlike := stored.unlike():
            warnings.warn(
                f"camera {name!r}: pictures of {some(unlike)} are unlike those of the others: dark, frozen, elsewhere?"
                " If they are faulty, remove these recordings from the source and convert it again",
                stacklevel=2,
            )
        fitted = projection
        if fitted is None:
            width = part_widths(task).get(name, components)
            fitted = Projection.fit(stored.sample(held_out=False), width, encoder.identity)
        fitted = Projection.load(fitted.save(out / CAMERAS / f"{name}.safetensors"))  # in half precision, as in use
        embedded[name] = [fitted(features) for features in stored.features()]
        reports[name] = stored.report(fitted)
    for file in (out / CAMERAS).glob("*.safetensors"):
        if file.stem not in chosen:  # of an interrupted call
            file.unlink()
    task, states = _with_columns(task, recordings, embedded)
    origin, added = map(np.asarray, task.origins or (0.0, 0.0))  # read_recordings has added them
    data = flatten_trajectories(
        [frames - origin for frames in states],
        [steps - added for steps in recordings.actions],
        action_dim=task.action_dim,
    )
    notes = {"embedded": chosen, "network": backbone.name, "sources": list(recordings.sources)}
    save_ted(data, out / "ted", task, notes)
    shutil.rmtree(out / "unfinished")
    return reports


def _with_columns(
    task: Task, recordings: Recordings, embedded: Mapping[str, Sequence[Tensor]]
) -> tuple[Task, list[np.ndarray]]:
    """Returns the task with the embeddings among its parts, and its observations."""
    further = {name: values[0].shape[1] for name, values in embedded.items() if name not in task.observation}
    if further:
        units = ("embedding",) * sum(further.values())
        task = replace(
            task,
            observation_parts={**task.observation_parts, **further},
            observation_origin=task.observation_origin and task.observation_origin + (0.0,) * sum(further.values()),
            observation_units=(task.observation_units or ("",) * task.observation_dim) + units,
            state={**task.state, **dict.fromkeys(further, "plain")} if task.state else {},
            robot=task.robot or tuple(range(task.state_dim)),
            defaults=replace(task.defaults, recovery=0.0),  # pictures show the recorded state, not a displaced one
        )
    own = {name: width for name, width in part_widths(task).items() if name not in embedded}
    if sum(own.values()) != recordings.states[0].shape[1]:
        raise DataError(
            f"task {task.name!r}",
            f"it has {sum(own.values())} columns besides the embeddings ({', '.join(own)}), but the data have"
            f" {recordings.states[0].shape[1]}: {', '.join(recordings.state_names)}",
        )
    ends = np.cumsum(list(own.values()))[:-1]
    columns = [dict(zip(own, np.split(states, ends, 1), strict=True)) for states in recordings.states]
    seen = [
        np.concatenate([embedded[name][index] if name in embedded else parts[name] for name in task.observation], 1)
        for index, parts in enumerate(columns)
    ]
    return task, seen


def _read(recordings: Recordings, camera: str, index: int, size: Sequence[int] | None = None) -> Iterator[np.ndarray]:
    try:
        yield from recordings.cameras[camera][index].read(size)
    except (ValueError, OSError, KeyError) as error:
        raise DataError(f"camera {camera!r} of {recordings.sources[index]}", str(error)) from error


class _CameraFeatures:
    """Features of one camera's frames in all trajectories, stored in files."""

    def __init__(self, camera: str, recordings: Recordings, encoder: FrozenImageEncoder, folder: Path):
        self.camera, self.recordings, self.encoder = camera, recordings, encoder
        self.clips = recordings.cameras[camera]
        about = [encoder.identity, [asdict(clip) for clip in self.clips]]
        key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
        self._files = [folder / f"{camera}-{key}" / f"{index:06d}.safetensors" for index in range(len(self.clips))]

    def embed(self) -> Iterator[int]:
        """Writes missing features of trajectories; yields the numbers of frames that are done."""
        for index, (file, clip) in enumerate(zip(self._files, self.clips, strict=True)):
            if file.is_file():
                yield len(clip)
                continue
            found, frames = [], _read(self.recordings, self.camera, index, self.encoder.size)
            while part := list(islice(frames, BATCH)):
                found.append(self.encoder.features(torch.from_numpy(np.stack(part))))
                yield len(part)
            with replacing_file(file) as aside:
                save_file({"features": torch.cat(found)}, aside)

    def features(self) -> Iterator[Tensor]:
        """Yields the features ``[T, F]`` of every trajectory."""
        for file in self._files:
            yield load_file(file)["features"]

    def unlike(self) -> list[str]:
        """Returns the sources of trajectories whose mean features are far from the median; none below 10."""
        means = torch.stack([features.mean(0) for features in self.features()])
        far = (means - means.median(0).values).norm(dim=1)
        odd = torch.nonzero(far > UNLIKE * far.median()).flatten() if len(far) >= HELD_OUT else ()
        return [self.recordings.sources[index] for index in odd]

    def sample(self, held_out: bool) -> Tensor:
        """Returns features of about ``MOST`` frames or fewer, evenly spaced."""
        rows = [*range(len(self.clips))]
        if len(rows) >= HELD_OUT:
            rows = [index for index in rows if (index % HELD_OUT == HELD_OUT - 1) == held_out]
        every = max(1, -(-sum(len(self.clips[index]) for index in rows) // MOST))
        return torch.cat([load_file(self._files[index])["features"][index % every :: every] for index in rows])

    def report(self, projection: Projection) -> CameraReport:
        """Reports the share of variance that components keep on held-out frames."""
        kept = projection.kept(self.sample(held_out=True))
        return CameraReport(self.encoder.size, projection.dim, kept)
