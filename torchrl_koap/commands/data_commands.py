# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap demos``, ``koap convert`` and ``koap validate``: record, convert and check demonstrations."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from tensordict import TensorDictBase

from torchrl_koap.commands.options import Command, training_call
from torchrl_koap.data import open_dataset, read_recordings, save_demonstrations
from torchrl_koap.data.action_kinds import describe_likely, likely_kinds
from torchrl_koap.data.d3il.conversion import CONVERTERS, find_raw_files
from torchrl_koap.data.formats import Recordings, write_recordings, writer_of
from torchrl_koap.data.planner_choices import observed_frames, planner_updates
from torchrl_koap.data.quality import drop_short, find_warnings, goal_columns, plan_coverage, trim_still
from torchrl_koap.data.sources import check_new, find_task_of
from torchrl_koap.data.ted import source_names, stored_folder
from torchrl_koap.envs.experts.demonstrations import RecordingReport, record_to_folder
from torchrl_koap.envs.experts.recording import expert_of
from torchrl_koap.envs.scooping.recording import VideoReport, record_videos
from torchrl_koap.keys import validate
from torchrl_koap.lookup import lookup
from torchrl_koap.runs.plugins import Plugins, load_plugins
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.tasks import Task, get_task

_READING = (
    *("control_hz", "resample", "observations", "episodes"),
    *("action_columns", "action_dim", "state_columns", "drop_columns"),
)
_DESCRIBING = ("name", "robot", "command", "action_kind", "targets", "action_units", "state_units", "max_steps")
_ONE_FOR_ALL = ("action_kind", "action_units", "state_units")


@dataclass(kw_only=True)
class Demos(Command):
    """Record scripted demonstrations.

    The same command resumes an interrupted recording (OUT/unfinished).

    Example: `koap demos --task avoiding --out demos`

    Attributes:
        out: folder to write, for `koap train --dataset`. Must not hold demonstrations yet.
        task: name of the task.
        episodes: number of demonstrations, spread evenly over the modes (default: that of the task).
        seed: seed of the experts' variation.
        threads: simulator threads.
        disturbance: share of the demonstrations in which the expert is disturbed at times (pushes, slips, late turns, a
            drifting height); those from which it recovers are kept, and OUT/ted/about.json lists the disturbances
            (default: that of the task).
        embodiment: for tasks recorded by a camera: "robot" (with actions) or "hand" (frames only); OUT is then a
            LeRobot data set with pictures, for `koap embed`.
        plugins: modules that register tasks; imported before anything else.
    """

    out: Path
    task: str = "avoiding"
    episodes: int | None = None
    seed: int = 0
    threads: int = 2
    disturbance: float | None = None
    embodiment: str | None = None
    plugins: Plugins = ()

    def __call__(self) -> RecordingReport | VideoReport:
        """Records and writes demonstrations; returns a report."""
        load_plugins(self.plugins)
        task = get_task(self.task)
        if task.env is None or task.expert is None:
            lacks = "environment" if task.env is None else "scripted expert"
            raise ValueError(f"task {task.name!r} has no {lacks}: demonstrations cannot be recorded")
        episodes = task.defaults.demonstrations if self.episodes is None else self.episodes
        embodiments = expert_of(task).embodiments
        if self.embodiment is not None and not embodiments:
            raise ValueError(f"--embodiment was given, but task {task.name!r} has only one embodiment")
        if self.embodiment is None and embodiments:
            raise ValueError(f"task {task.name!r} needs --embodiment {' or '.join(embodiments)}")
        if embodiments:
            lookup(embodiments, self.embodiment, "embodiment")
            if self.disturbance:
                raise ValueError("--disturbance was given, but demonstrations with a camera cannot be disturbed")
        with progress_bar(episodes, "recording", unit="episode", delay=0.5) as bar:  # no bar before an error
            if self.embodiment is not None:
                return record_videos(self.out, self.embodiment, episodes, self.seed, count_up_to(bar), task=task)
            options = {"num_threads": self.threads, "disturbance": self.disturbance}
            return record_to_folder(self.out, task, episodes, self.seed, progress=count_up_to(bar), **options)


@dataclass(kw_only=True)
class Convert(Command):
    """Turn recordings of any robot, few with actions, into a data set.

    The data set also describes the task: names, units and roles of the columns.

    Example: `koap convert recordings --out arm --control-hz 30`

    Attributes:
        source: a folder of *.npz, *.csv or *.parquet files, a LeRobot data set, HDF5 in the layout of robomimic or
            ALOHA (a file or a folder), minari:NAME, or (with --to) a data set of this library.
        out: folder to write.
        to: another format than this library's: "npz" or "lerobot" (3.0).
        name: name of the task (default: that of the folder).
        control_hz: frames per second, in place of time stamps (default: as the source says).
        resample: new frames per second: for irregular time stamps, or if a plan covers too little of the motion.
        observations: features of a LeRobot data set or entries of an HDF5 file that make up the state (default: all
            but images).
        episodes: which episodes of a LeRobot data set to read, such as those that were downloaded (default: all).
        action_columns: columns of CSV or parquet tables that are actions (default: those named action...).
        action_dim: number of action columns, needed if no recording has actions.
        state_columns: columns that make up the state, in that order (default: all but clocks, counters, rewards and
            flags of episodes).
        drop_columns: state and action columns to leave out.
        trim_still: cut the frames at both ends of trajectories in which nothing moves.
        drop_short: leave out trajectories that are shorter than a window.
        robot: state columns of the robot itself, which the controller reads (default: all that change within a
            recording, without the command).
        command: neighbouring columns that repeat the last command; they are hidden from planner and controller.
        action_kind: kind of each action column, or one for all: "delta" (velocities, changes), "absolute"
            (targets of state columns) or "raw" (neither, such as torques or normalised targets); with --resample
            "change" (over one frame, summed) or "velocity" (held) instead of "delta" (default: delta).
        targets: for each absolute action the state column that it is the target of (default: the robot's).
        action_units: unit of each action column, or one for all.
        state_units: unit of each state column, or one for all.
        max_steps: steps after which an episode counts as failed (default: 1.5 times the longest demonstration).
        plugins: modules that add a format of their own to torchrl_koap.data.formats.FORMATS.
    """

    source: tyro.conf.Positional[str]
    out: Path
    to: str | None = None
    name: str | None = None
    control_hz: float | None = None
    resample: float | None = None
    observations: tuple[str, ...] = ()
    episodes: tuple[int, ...] = ()
    action_columns: tuple[str, ...] = ()
    action_dim: int | None = None
    state_columns: tuple[str, ...] = ()
    drop_columns: tuple[str, ...] = ()
    trim_still: bool = False
    drop_short: bool = False
    robot: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    action_kind: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    state_units: tuple[str, ...] = ()
    max_steps: int | None = None
    plugins: Plugins = ()

    def __call__(self) -> dict[str, Any]:
        """Reads, checks and writes."""
        load_plugins(self.plugins)
        return self._bring_in() if self.to is None else self._take_out(self.to)

    def _bring_in(self) -> dict[str, Any]:
        if stored_folder(self.source) is not None:
            raise ValueError(f"{self.source} is a data set of this library already: name another format by --to")
        check_new(self.out)
        with warnings.catch_warnings(record=not self.quiet) as unlikely:  # with --quiet, no table shows them later
            warnings.simplefilter("always")
            recordings = self._read()
            folder = save_demonstrations(self.out, recordings, **self._given(_DESCRIBING))
        data, task = open_dataset(folder)
        origin = zip(task.observation_names, task.observation_origin, strict=False)
        return {
            "data set": str(folder),
            "task": task.name,
            "steps": len(data),
            **_contents(recordings),
            "controller reads": ", ".join(task.state_names[column] for column in task.robot),
            "action kind": ", ".join(self.action_kind) or "delta (default)",
            "labels look": describe_likely(likely_kinds(data, task)) or "like no kind: too few labels",
            "constant in each trajectory": ", ".join(goal_columns(recordings)) or "nothing",
            "subtracted": ", ".join(f"{value:.6g} from {name}" for name, value in origin if value) or "nothing",
            "planner observes": observed_frames(data, task)[1],
            "planner trains": planner_updates(len(data))[1],
            "a plan covers": plan_coverage(data, task.control_hz)[0],
            **_numbered([str(warning.message) for warning in unlikely or ()], data),
            "next": _next(folder, task, recordings),
        }

    def _take_out(self, kind: str) -> dict[str, Any]:
        writer_of(kind, self.out)  # raises before anything is read
        reading = self._reading()
        for name in self._given([name for name in _DESCRIBING if name not in reading]):
            raise ValueError(f"--{name.replace('_', '-')} was given, but format {kind!r} does not hold it")
        recordings = self._read()
        written = {"written": str(write_recordings(recordings, self.out, kind)), "format": kind}
        left = ", ".join(recordings.cameras)
        return written | _contents(recordings) | ({"cameras": f"{left}: frames are not written"} if left else {})

    def _read(self) -> Recordings:
        recordings = read_recordings(self.source, **self._given(self._reading()))
        for asked, change in ((self.trim_still, trim_still), (self.drop_short, drop_short)):
            recordings = change(recordings) if asked else recordings
        return recordings

    def _reading(self) -> tuple[str, ...]:
        """Returns the options of the reader, with ``action_kind`` if actions are resampled."""
        return _READING if self.resample is None else (*_READING, "action_kind")

    def _given(self, options: Sequence[str]) -> dict[str, Any]:
        """Returns the options that were given; a single value for all columns is unpacked."""
        given = {name: value for name, value in vars(self).items() if name in options and value not in (None, ())}
        return {name: value[0] if name in _ONE_FOR_ALL and len(value) == 1 else value for name, value in given.items()}


@dataclass(kw_only=True)
class Validate(Command):
    """Report every problem of a folder of demonstrations.

    Warnings name what is valid but unlikely.

    Example: `koap validate arm`

    Attributes:
        dataset: folder written by `koap demos`, `koap convert` or save_demonstrations, or of D3IL's raw pickles.
        task: name of the task (default: that of the data set, if it names one; else "avoiding").
        plugins: modules that register tasks; imported before anything else.
    """

    dataset: tyro.conf.Positional[str]
    task: str | None = None
    plugins: Plugins = ()

    def __call__(self) -> dict[str, str]:
        """Reads and checks demonstrations."""
        load_plugins(self.plugins)
        task = find_task_of(self.dataset, self.task)
        with progress_bar(None, "demonstrations", unit="episode", delay=3) as bar:
            data = validate(open_dataset(self.dataset, task=task, progress=count_up_to(bar))[0])
        stored = stored_folder(self.dataset)
        names = source_names(self.dataset) if stored else find_raw_files(CONVERTERS[task.source], self.dataset)
        found = _numbered(find_warnings(data, task, list(map(str, names))), data)
        lengths = data["episode"].unique(return_counts=True)[1]
        labels = int(data["has_action"].sum())
        return {
            "trajectories": str(len(lengths)),
            "steps": str(len(data)),
            "labelled steps": str(labels) if labels else "none: `koap train` needs a few",
            "shortest, longest": f"{int(lengths.min())}, {int(lengths.max())}",
            "observation, action columns": f"{data['observation'].shape[-1]}, {data['action'].shape[-1]}",
            **found,
            "result": f"no problem found, {len(found)} warning(s)" if found else "no problem found",
        }


def _next(folder: Path, task: Task, recordings: Recordings) -> str:
    if not recordings.num_labels:
        return "add actions to a few recordings and convert them again: `koap train` needs them"
    if not recordings.cameras:
        return training_call(folder, task.name)
    where = shlex.quote(str(folder))
    cameras = " ".join(f"--camera {shlex.quote(name)}" for name in recordings.cameras)
    return f"koap embed {where} {cameras} --out {where}_seen"


def _contents(recordings: Recordings) -> dict[str, Any]:
    return {
        "trajectories": len(recordings.states),
        "labelled steps": recordings.num_labels,
        "states": ", ".join(recordings.state_names),
        "actions": ", ".join(recordings.action_names),
        "frames per second": recordings.control_hz,
        "cameras": ", ".join(recordings.cameras) or "none",
        "skipped": ", ".join(recordings.skipped) or "nothing",
    }


def _numbered(found: list[str], data: TensorDictBase) -> dict[str, str]:
    if len(data["episode"].unique()) == 1:
        hint = "there is only one trajectory: if it holds several episodes, mark their ends"
        found = [f"{hint} (a column 'episode_index' or 'timeouts')", *found]
    return {f"warning {number}": warning for number, warning in enumerate(found, 1)}
