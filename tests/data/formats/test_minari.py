# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests local Minari data sets."""

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from recording_writers import store_minari

from torchrl_koap.data.formats.minari import read_minari
from torchrl_koap.files import DataError

PLACES = [np.full(1, 0.5 * step, np.float32) for step in range(7)]


def write(root, space, observations, infos=None):
    episode = observations, [np.full(1, 0.5, np.float32)] * 6
    return store_minari(root, "slider/test-v0", space, Box(-1, 1, (1,)), [episode] * 2, infos)


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    space = Dict({"place": Box(-9, 9, (1,)), "camera": Box(0, 255, (2, 2, 3), np.uint8)})
    return write(tmp_path, space, {"place": PLACES, "camera": [np.zeros((2, 2, 3), np.uint8)] * 7})


def test_a_data_set_as_arrays(dataset):
    recordings = read_minari(dataset, control_hz=25)
    assert recordings.state_names == ("place",) and recordings.skipped == ("camera",)
    assert [frames.shape for frames in recordings.states] == [(7, 1), (7, 1)]
    assert recordings.num_labels == 12
    np.testing.assert_allclose(np.diff(recordings.states[0], axis=0), recordings.actions[0])


def test_an_unknown_data_set_and_rate(dataset):
    with pytest.raises(FileNotFoundError, match="'slider/other-v0' is not on this machine"):
        read_minari("minari:slider/other-v0")
    with pytest.raises(DataError, match=r"its environment cannot be made \(\w+: .*pass control_hz"):
        read_minari(dataset)


def test_the_rate_is_that_of_the_environment(dataset, monkeypatch):
    environment = SimpleNamespace(metadata={"render_fps": 12.5})
    monkeypatch.setattr("minari.MinariDataset.recover_environment", lambda self: environment)
    assert read_minari(dataset).control_hz == 12.5


def test_numbered_actions_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episode = PLACES, [1] * 6
    name = store_minari(tmp_path, "slider/test-v0", Box(-9, 9, (1,)), Discrete(3), [episode] * 2)
    with pytest.raises(DataError, match=r"episode 0, episode 1: actions must be \[T, a\], got int64 \[6\]"):
        read_minari(name, control_hz=25)


def test_columns_that_would_replace_each_other_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    space = Dict({"a": Box(-9, 9, (3,)), "a_0": Box(-9, 9, (1,))})
    name = write(tmp_path, space, {"a": [np.repeat(place, 3) for place in PLACES], "a_0": PLACES})
    with pytest.raises(DataError, match="episode 0, episode 1: two entries have a column a_0: rename one of them"):
        read_minari(name, control_hz=25)


@pytest.mark.parametrize("width", [1, 2])
def test_observations_that_are_a_tuple(width, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    space = Tuple([Box(-9, 9, (size,)) for size in (1, width)])
    name = write(tmp_path, space, (PLACES, [np.repeat(place, width) for place in PLACES]))
    found = read_minari(name, control_hz=25)
    assert found.state_names == (("0", "1") if width == 1 else ("0", "1_0", "1_1"))
    np.testing.assert_array_equal(found.states[0], np.repeat(PLACES, 1 + width, 1))


def test_parts_of_a_tuple_are_in_the_order_of_their_numbers(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    parts = tuple([np.full(1, number, np.float32)] * 7 for number in range(12))
    found = read_minari(write(tmp_path, Tuple([Box(-99, 99, (1,))] * 12), parts), control_hz=25)
    assert found.state_names == tuple(map(str, range(12))) and found.states[0][0].tolist() == [*range(12)]


def test_infos_are_listed(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    infos = {"force": [np.zeros(3)] * 7, "robot": {"joint": [0.0] * 7}}
    found = read_minari(write(tmp_path, Box(-9, 9, (1,)), PLACES, infos), control_hz=25)
    assert found.skipped == ("infos/force", "infos/robot_joint") and found.state_names == ("state",)
