# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings of a D3IL task as D3IL's raw pickles: the way back of :mod:`torchrl_koap.data.d3il.conversion`.

What the observations do not hold is written as if it had been at rest: the height of the tool and of the boxes where a
task observes the plane alone, a box's tilt, the half turn that the tangent of a yaw leaves open. Actions are not
written: D3IL's are differences of the commands, which the observations hold.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchrl_koap.data.d3il.conversion import Converter, get_converter
from torchrl_koap.data.d3il.raw import RawEpisode, write_raw_episode
from torchrl_koap.data.recordings.recordings import Recordings, RecordingsError
from torchrl_koap.tasks import TASKS, Task, get_task

HEIGHT = 0.12  # m of the tool above the table, where it is held
_TOLERANCE = 1e-5  # of an action, for data that were stored as float32


def write_d3il(recordings: Recordings, out: Path) -> None:
    """Writes a pickle per trajectory, ``env_000_00.pkl`` and so on.

    Args:
        recordings (Recordings): all observation columns of a D3IL task, every step with its action.
        out (Path): the folder to make.

    Raises:
        RecordingsError: if the columns are those of no D3IL task, if steps lack their action (raw pickles cannot hide
            one), or if actions are other than what D3IL's tools would read from the commands.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data import read_raw_episode
        >>> from torchrl_koap.data.d3il.writing import write_d3il
        >>> from torchrl_koap.data.recordings import make_recordings
        >>> from torchrl_koap.tasks import get_task
        >>> frames = np.repeat(np.arange(5.0)[:, None], 4, 1)
        >>> names = get_task("avoiding").observation_names
        >>> recordings = make_recordings([frames], [np.ones((4, 2))], state_names=names, control_hz=33.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_d3il(recordings, Path(folder) / "raw")
        ...     read_raw_episode(Path(folder) / "raw" / "env_000_00.pkl").robot["des_c_pos"][2]
        array([2.  , 2.  , 0.12])
    """
    task = _task_of(recordings, out)
    converter = get_converter(task.name)
    episodes, problems = [], []
    for index, (frames, actions) in enumerate(zip(recordings.states, recordings.actions, strict=True)):
        episode = _episode(task, converter, frames)
        problem = _difference(converter, episode, frames, actions)
        if problem:
            problems.append(f"trajectory {index}: {problem}")
        episodes.append(episode)
    if problems:
        raise RecordingsError(str(out), problems)
    digits = max(3, len(str(len(episodes) - 1)))
    for index, episode in enumerate(episodes):
        write_raw_episode(out / f"env_{index:0{digits}}_00.pkl", episode)


def _task_of(recordings: Recordings, out: Path) -> Task:
    for name in TASKS:
        task = get_task(name)
        if task.converter is not None and tuple(task.observation_names) == tuple(recordings.state_names):
            return task
    raise RecordingsError(
        str(out),
        [f"columns are those of no D3IL task ({', '.join(recordings.state_names)}): raw pickles hold nothing else"],
    )


def _episode(task: Task, converter: Converter, frames: np.ndarray) -> RawEpisode:
    """A raw episode that converts to these observations ``[T, obs]``."""
    frames = np.array(frames)  # recordings are read-only

    def block(name: str) -> np.ndarray:
        columns = [i for i, column in enumerate(task.observation_names) if column.rpartition("_")[0] == name]
        return frames[:, columns] if columns else frames[:, [task.observation_names.index(name)]]

    if "des_j_pos" in converter.robot:
        desired = block("desired_joints_and_gripper")
        robot = {"des_j_pos": desired[:, :7], "gripper_width": desired[:, 7]}
        robot |= {"j_pos": block("measured_joints"), "c_pos": block("tcp_position")}
    elif "desired_xyz_0" in task.observation_names:
        robot = {"des_c_pos": block("desired_xyz"), "c_pos": block("measured_xyz")}
    else:
        robot = {"des_c_pos": _in_space(block("desired_xy")), "c_pos": _in_space(block("measured_xy"))}
    objects = {}
    for name in converter.objects:
        called = _column_name(name)
        if f"{called}_quaternion_0" in task.observation_names:
            position, quat = block(f"{called}_position"), block(f"{called}_quaternion")
        else:
            flat = f"{called}_xy_0" in task.observation_names
            position = _in_space(block(f"{called}_xy"), 0.0) if flat else block(f"{called}_position")
            quat = _upright(block(f"{called}_tan_yaw")[:, 0])
        objects[name] = {"pos": position, "quat": quat}
    return RawEpisode(robot=robot, objects=objects)


def _column_name(logged: str) -> str:
    """``red-box1`` is ``red_1`` among the columns, ``push-box`` is ``box`` and ``target-box`` is ``target``."""
    if logged in ("push-box", "target-box"):
        return {"push-box": "box", "target-box": "target"}[logged]
    colour, _, number = logged.partition("-box")
    return f"{colour}_{number}" if number else colour


def _in_space(plane: np.ndarray, height: float = HEIGHT) -> np.ndarray:
    return np.concatenate([plane, np.full((len(plane), 1), height)], 1)


def _upright(tan_yaw: np.ndarray) -> np.ndarray:
    half = np.arctan(tan_yaw) / 2
    zeros = np.zeros_like(half)
    return np.stack([np.cos(half), zeros, zeros, np.sin(half)], 1)


def _difference(converter: Converter, episode: RawEpisode, frames: np.ndarray, actions: np.ndarray) -> str | None:
    """What would be read from the pickle that is not in the recordings, in words."""
    unknown = int(np.isnan(actions).any(-1).sum())
    if unknown:
        return f"{unknown} steps have no action; raw pickles cannot hide one"
    observed, moved = converter.convert(episode)
    if not np.allclose(observed, frames, rtol=1e-4, atol=_TOLERANCE):
        return "its observations are none that a raw pickle can hold"
    worst = float(np.abs(moved - actions).max(initial=0))
    if worst > _TOLERANCE:
        return f"actions differ by up to {worst:.3g} from the differences of the commands, which are D3IL's actions"
    return None
