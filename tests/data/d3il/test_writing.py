# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw pickles that are written are read as what they were written from."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_koap.data import D3ILExperienceReplay
from torchrl_koap.data.d3il.conversion import get_converter
from torchrl_koap.data.d3il.writing import write_d3il
from torchrl_koap.data.recordings import RecordingsError, make_recordings
from torchrl_koap.data.recordings.writers import recordings_of, write_recordings
from torchrl_koap.data.ted import save_ted
from torchrl_koap.tasks import TASKS, get_task

NAMES = [name for name in TASKS if get_task(name).converter is not None]


def recorded(task, steps=30, seed=0):
    """Observations of a task that a recorder could have made, and the actions that belong to them."""
    rng = np.random.default_rng(seed)
    frames = rng.normal(size=(steps + 1, len(task.observation_names))).cumsum(0) / 100
    for index, name in enumerate(task.observation_names):
        if name.endswith("quaternion_0"):
            turned = frames[:, index : index + 4]
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    if "gripper_width" in task.observation_names:  # the recorder has one width for both
        width = np.abs(frames[:, 7])
        frames[:, 7] = frames[:, task.observation_names.index("gripper_width")] = width
    actions = np.diff(frames[:, : len(task.action_names)], axis=0)
    if "gripper_width" in task.observation_names:
        actions[:, -1] = gripper_actions(task, frames)
    return frames, actions


def gripper_actions(task, frames):
    """As the converter reads them off the widths."""
    from torchrl_koap.data.d3il.writing import _episode

    converter = get_converter(task.name)
    return converter.convert(_episode(task, converter, frames))[1][:, -1]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_is_read_as_it_was(name, tmp_path):
    task = get_task(name)
    pairs = [recorded(task, steps, seed) for seed, steps in enumerate((30, 25))]
    states, actions = zip(*pairs, strict=True)
    recordings = make_recordings(states, actions, state_names=task.observation_names, control_hz=task.control_hz)
    write_d3il(recordings, tmp_path / "raw")
    data = D3ILExperienceReplay(name, tmp_path / "raw", cache=tmp_path / "cache").data
    np.testing.assert_allclose(data["observation"][:30], states[0][:-1], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(data["observation"][30:], states[1][:-1], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(data["action"], np.concatenate(actions), rtol=1e-5, atol=1e-6)


def test_from_a_data_set_of_this_library_and_back(tmp_path):
    task = get_task("aligning")
    states, actions = recorded(task)
    recordings = make_recordings([states], [actions], state_names=task.observation_names, control_hz=task.control_hz)
    write_recordings(recordings, tmp_path / "raw", "d3il")
    data = D3ILExperienceReplay("aligning", tmp_path / "raw", cache=tmp_path / "cache").data
    save_ted(data, tmp_path / "own" / "ted", task="aligning")
    write_recordings(recordings_of(tmp_path / "own"), tmp_path / "again", "d3il")
    again = D3ILExperienceReplay("aligning", tmp_path / "again", cache=tmp_path / "cache").data
    np.testing.assert_allclose(again["observation"], data["observation"], rtol=1e-6)
    np.testing.assert_allclose(again["action"], data["action"], atol=1e-6)


def test_what_raw_pickles_cannot_hold_is_refused(tmp_path):
    task = get_task("avoiding")
    states, actions = recorded(task)
    hidden, other = actions.copy(), actions + 0.01
    hidden[3] = np.nan
    for chosen, said in ((hidden, "trajectory 0: 1 steps have no action"), (other, "actions differ by up to 0.01")):
        recordings = make_recordings([states], [chosen], state_names=task.observation_names, control_hz=33)
        with pytest.raises(RecordingsError, match=said):
            write_d3il(recordings, tmp_path / "raw")
    foreign = make_recordings([np.zeros((5, 3))], [np.zeros((4, 2))], control_hz=33)
    with pytest.raises(RecordingsError, match="columns are those of no D3IL task"):
        write_d3il(foreign, tmp_path / "raw")
    assert not (tmp_path / "raw").exists()
