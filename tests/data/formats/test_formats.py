# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the format of a folder, file or name selects the reader, and that written data are read back."""

import re

import numpy as np
import pytest
from recording_writers import WRITERS, columns

from torchrl_koap.data import make_recordings, open_dataset, read_recordings, save_demonstrations
from torchrl_koap.data.formats import FORMATS, write_recordings
from torchrl_koap.data.sources import check_new
from torchrl_koap.files import DataError

STATES, ACTIONS = ("x", "width", "y"), ("force", "turn")


@pytest.fixture
def recordings():
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(length, 3)) for length in (5, 4, 7)]
    actions = [rng.normal(size=(4, 2)), None, rng.normal(size=(6, 2))]
    actions[2][3] = np.nan
    return make_recordings(states, actions, state_names=STATES, action_names=ACTIONS, control_hz=20.0)


def test_a_folder_of_tables(tmp_path):
    np.savez(tmp_path / "a.npz", states=np.zeros((5, 2)), actions=np.ones((4, 1)))
    assert read_recordings(tmp_path, control_hz=10).num_labels == 4
    with pytest.raises(DataError, match="control_hz .* must be a positive number of frames per second, got 0"):
        read_recordings(tmp_path, control_hz=0)
    with pytest.raises(ValueError, match="observations .*: not an option for a table, or a folder of "):
        read_recordings(tmp_path, control_hz=10, observations=["x"])


@pytest.mark.parametrize("below", ["", "ted"])
def test_a_data_set_of_this_library(below, recordings, tmp_path):
    save_demonstrations(tmp_path / "arm", recordings, robot=("x",))
    again = read_recordings(tmp_path / "arm" / below)
    assert (again.state_names, again.control_hz, again.num_labels) == (STATES, 20.0, 9)
    np.testing.assert_allclose(again.states[2], recordings.states[2], rtol=1e-6)
    np.testing.assert_allclose(again.actions[2], recordings.actions[2], rtol=1e-6)
    with pytest.raises(ValueError, match="control_hz .*: not an option for a data set of this library"):
        read_recordings(tmp_path / "arm", control_hz=3)


def test_a_tilde_is_the_home_folder(recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert save_demonstrations("~/arm", recordings) == tmp_path / "arm"
    assert write_recordings(recordings, "~/tables", "npz") == tmp_path / "tables"
    assert read_recordings("~/tables").num_labels == read_recordings("~/arm").num_labels == 9
    for check in (lambda: check_new("~/arm"), lambda: write_recordings(recordings, "~/tables", "npz")):
        with pytest.raises(FileExistsError):
            check()


def test_nothing_to_read(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ValueError, match="holds no recordings that can be read; there are readers for minari:NAME"):
        read_recordings(tmp_path)
    np.save(tmp_path / "run_0.npy", np.zeros((5, 2)))
    with pytest.raises(ValueError, match=r"\*.npy files are not read: save each recording with np.savez\(file, s"):
        read_recordings(tmp_path)
    (tmp_path / "hopper.pkl").touch()
    for source in (tmp_path, tmp_path / "hopper.pkl"):
        with pytest.raises(ValueError, match=r"pickles are not read: save .* by np.savez\(file, observations="):
            read_recordings(source)
    with pytest.raises(FileNotFoundError, match="none does not exist"):
        read_recordings(tmp_path / "none")


def test_a_run_is_no_recording(trained_run, demonstrations):
    said = f"it is a run of `koap train`, which was trained on the data set {demonstrations}"
    for read in (read_recordings, open_dataset):
        with pytest.raises(DataError, match=re.escape(said)):
            read(trained_run)


@pytest.mark.parametrize("kind", [name for name, form in FORMATS.items() if form.write is not None])
def test_round_trip(kind, recordings, tmp_path):
    if kind == "lerobot":
        pytest.importorskip("pyarrow")
    again = read_recordings(write_recordings(recordings, tmp_path / "demo", kind))
    tolerance = 1e-6 if kind == "lerobot" else 0
    assert len(again.states) == 3 and again.num_labels == 9 and again.control_hz == 20
    for index in range(3):
        np.testing.assert_allclose(again.states[index], recordings.states[index], rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(again.actions[index], recordings.actions[index], rtol=tolerance, atol=tolerance)
    assert again.state_names == STATES and again.action_names == ACTIONS


@pytest.mark.parametrize("kind", ["npz", "lerobot"])
def test_names_of_actions_survive_without_labels(kind, tmp_path):
    bare = make_recordings([np.eye(3)], action_names=ACTIONS, state_names=STATES, control_hz=20.0)
    again = read_recordings(write_recordings(bare, tmp_path / "out", kind))
    assert again.action_names == ACTIONS and again.num_labels == 0


def test_refusals_of_writing(recordings, tmp_path):
    with pytest.raises(ValueError, match="unknown format 'lerobt'; did you mean 'lerobot'"):
        write_recordings(recordings, tmp_path / "a", "lerobt")
    with pytest.raises(ValueError, match="unknown format 'robomimic'"):
        write_recordings(recordings, tmp_path / "a", "robomimic")
    (tmp_path / "there").mkdir()
    with pytest.raises(FileExistsError, match="there exists already"):
        write_recordings(recordings, tmp_path / "there", "npz")
    unknown = make_recordings([np.zeros((5, 1))], [np.zeros((4, 1))])
    with pytest.raises(DataError, match="the rate is not known"):
        write_recordings(unknown, tmp_path / "b", "lerobot")


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("dtype", ["float16", "int64", "uint8", "bool"])
def test_numbers_of_every_type_keep_their_value(kind, dtype, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = []
    for seed in range(2):
        states, actions = columns(seed)
        drawn = {name: np.abs(9 * values).astype(dtype) for name, values in states.items() if name != "timestamp"}
        episodes.append(({"timestamp": states["timestamp"]} | drawn, actions))
    found = read_recordings(WRITERS[kind](tmp_path, episodes))
    assert found.state_names == ("q0", "q1", "q2") and found.control_hz == pytest.approx(20)
    for frames, (states, _) in zip(found.states, episodes, strict=True):
        wanted = np.stack([states[name] for name in found.state_names], 1).astype(np.float64)
        np.testing.assert_array_equal(frames, wanted)
        assert frames.dtype == np.float64


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_episodes_may_have_names_instead_of_numbers(kind, tmp_path):
    states, actions = columns(0)
    named = states | {"episode": np.array(["reach", "push"]).repeat(20)}
    found = read_recordings(WRITERS[kind](tmp_path, [(named, actions)]))
    np.testing.assert_array_equal(np.stack(found.states)[..., 0], states["q0"].reshape(2, 20))


def test_recordings_in_another_format_are_listed(recordings, tmp_path):
    write_recordings(recordings, tmp_path / "arm", "lerobot")
    assert "another format" not in str(read_recordings(tmp_path / "arm").skipped)
    np.savez(tmp_path / "arm" / "more.npz", states=np.zeros((4, 2)))
    (said,) = [said for said in read_recordings(tmp_path / "arm").skipped if "another format" in said]
    assert said.startswith("a table, or a folder of tables")
