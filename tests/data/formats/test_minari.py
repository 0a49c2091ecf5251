# This source code is licensed under the MIT license found in the LICENSE file.
"""Minari data sets on this machine."""

from __future__ import annotations

import importlib.util

import gymnasium
import numpy as np
import pytest

from torchrl_koap.data.formats.minari import read_minari
from torchrl_koap.files import DataError

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("minari") is None, reason="Minari is not installed (extra 'minari')"
)


class Slider:
    """Spaces of a point on a line with a camera."""

    observation_space = gymnasium.spaces.Dict(
        {"place": gymnasium.spaces.Box(-9, 9, (1,)), "camera": gymnasium.spaces.Box(0, 255, (2, 2, 3), np.uint8)}
    )
    action_space = gymnasium.spaces.Box(-1, 1, (1,))


PLACES = [np.full(1, 0.5 * step, np.float32) for step in range(7)]


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    camera = [np.zeros((2, 2, 3), np.uint8)] * 7
    return write(tmp_path, Slider.observation_space, {"place": PLACES, "camera": camera})


def write(root, space, observations):
    """Written through Minari's own storage: its collector needs packages that only recording needs."""
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    folder = root / "slider" / "test-v0" / "data"
    folder.mkdir(parents=True)
    storage = MinariStorage.new(folder, space, Slider.action_space)
    episodes = [
        EpisodeBuffer(
            id=number,
            seed=0,
            observations=observations,
            actions=[np.full(1, 0.5, np.float32)] * 6,
            rewards=[0.0] * 6,
            terminations=[False] * 5 + [True],
            truncations=[False] * 6,
            infos={},
        )
        for number in range(2)
    ]
    storage.update_episodes(episodes)
    storage.update_metadata({"dataset_id": "slider/test-v0", "minari_version": "0.5.4"})
    return "slider/test-v0"


def test_a_data_set_as_arrays(dataset):
    recordings = read_minari(f"minari:{dataset}", control_hz=25)
    assert recordings.state_names == ("place",) and recordings.skipped == ("camera",)
    assert [frames.shape for frames in recordings.states] == [(7, 1), (7, 1)]
    assert recordings.num_labels == 12
    np.testing.assert_allclose(np.diff(recordings.states[0], axis=0), recordings.actions[0])


def test_an_unknown_data_set_and_rate(dataset):
    with pytest.raises(FileNotFoundError, match="'slider/other-v0' is not on this machine"):
        read_minari("minari:slider/other-v0")
    with pytest.raises(DataError, match="pass control_hz"):
        read_minari(f"minari:{dataset}")


@pytest.mark.parametrize("width", [1, 2])
def test_observations_that_are_a_tuple(width, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    spaces = [gymnasium.spaces.Box(-9, 9, (size,)) for size in (1, width)]
    name = write(tmp_path, gymnasium.spaces.Tuple(spaces), (PLACES, [np.repeat(place, width) for place in PLACES]))
    found = read_minari(f"minari:{name}", control_hz=25)
    assert found.state_names == (("0", "1") if width == 1 else ("0", "1_0", "1_1"))
    np.testing.assert_array_equal(found.states[0], np.repeat(PLACES, 1 + width, 1))
