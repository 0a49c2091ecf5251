# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings through TorchRL's own ``load_dataset``: the numbers, labels and tasks of every reader."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.data.datasets import load_dataset

from torchrl_koap.data import LabelBudget, RecordedExperienceReplay, save_demonstrations
from torchrl_koap.data.recordings import make_recordings
from torchrl_koap.data.recordings.writers import write_recordings

NEEDS = {"robomimic": "h5py", "lerobot": "pyarrow", "lerobot-2.1": "pyarrow", "minari": "minari"}


@pytest.fixture
def recordings():
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(length, 3)) for length in (6, 5)]
    return make_recordings(states, [rng.normal(size=(5, 2)), None], state_names=("a", "b", "c"), control_hz=20.0)


@pytest.mark.parametrize("kind", ["npz", *NEEDS])
def test_every_reader_is_reached(kind, recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    if kind in NEEDS:
        pytest.importorskip(NEEDS[kind])
    place = {"robomimic": tmp_path / "a.hdf5", "minari": "minari:koap/a-v0"}.get(kind, tmp_path / "a")
    dataset = load_dataset(f"koap:{write_recordings(recordings, place, kind)}", batch_size=4)
    assert isinstance(dataset, RecordedExperienceReplay) and dataset.sample().shape == (4,)
    assert dataset.task.control_hz == 20 and dataset.task.observation_names == ("a", "b", "c")
    assert dataset.data["has_action"].squeeze(-1).tolist() == 5 * [True] + 4 * [False]
    torch.testing.assert_close(dataset.data["action"][:5], torch.as_tensor(recordings.actions[0]).float())
    torch.testing.assert_close(dataset.data["observation"][5:], torch.as_tensor(recordings.states[1][:-1]).float())


@pytest.mark.parametrize("below", ["", "ted"])
def test_a_data_set_of_this_library_keeps_its_task(below, recordings, tmp_path):
    save_demonstrations(tmp_path / "arm", recordings, robot=("a",), action_units="N")
    dataset = load_dataset(f"koap:{tmp_path / 'arm' / below}", label_budget=LabelBudget(1.0))
    assert dataset.task.name == "arm" and dataset.task.robot == (0,) and dataset.label_report.labelled_transitions == 5
    with pytest.raises(ValueError, match="holds its description; control_hz cannot be given"):
        RecordedExperienceReplay(tmp_path / "arm", control_hz=3)


def test_a_description_and_what_is_not_there(recordings, tmp_path):
    write_recordings(recordings, tmp_path / "a", "npz")
    dataset = RecordedExperienceReplay(tmp_path / "a", description={"name": "pick", "robot": ["b"]})
    assert dataset.task.name == "pick" and dataset.task.robot == (1,)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load_dataset(f"koap:{tmp_path / 'b'}")
