# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests ``koap convert`` and ``koap validate``: written files, messages, errors."""

import re
import shutil

import numpy as np
import pytest
from camera_sets import write_filmed
from command_calls import fails
from tiny_runs import koap, write_demonstrations

from torchrl_koap.data import formats, save_demonstrations
from torchrl_koap.data.sources import find_task_of
from torchrl_koap.data.ted import load_ted


def test_data_of_an_own_task_are_validated_without_naming_it(arm, capsys):
    assert koap("validate", arm) == 0
    assert "no problem found" in capsys.readouterr().out
    assert koap("validate", arm, "--task", "sorting") == 1
    assert "holds its own task 'arm', not 'sorting'" in capsys.readouterr().err


def test_a_data_set_in_another_format(arrays, arm, tmp_path, capsys):
    assert koap("convert", arm, "--out", tmp_path / "plain", "--to", "npz") == 0
    assert re.search("^skipped +units, kinds of actions and roles of columns$", capsys.readouterr().out, re.MULTILINE)
    assert koap("convert", tmp_path / "plain", "--out", tmp_path / "again", "--robot", "q1", "q2") == 0
    frames = find_task_of(tmp_path / "again").defaults.planner["frames"]
    said = capsys.readouterr().out
    assert re.search(rf"planner observes +{frames} frame", said) and re.search(
        "planner trains +at most 3,000 updates", said
    )
    one, other = (load_ted(folder / "ted")[0] for folder in (arm, tmp_path / "again"))
    assert (one["observation"] == other["observation"]).all() and (one["has_action"] == other["has_action"]).all()


@pytest.mark.parametrize("to", [(), ("--to", "npz")])
def test_actions_that_are_known_in_part_are_counted(to, tmp_path, capsys):
    rows = np.random.default_rng(0).normal(size=(30, 2))
    (tmp_path / "raw").mkdir()
    for name, unknown in {"a": 0, "b": 3}.items():
        actions = rows[1:].copy()
        actions[:unknown, 0] = np.nan
        np.savez(tmp_path / "raw" / f"{name}.npz", states=rows, actions=actions, control_hz=9.0)
    assert koap("convert", tmp_path / "raw", "--out", tmp_path / "arm", *to) == 0
    said = r"skipped +actions of which only some columns are known \(3 in trajectory b.npz\)"
    assert re.search(said, capsys.readouterr().out)


def test_without_labels_no_training_is_proposed(tmp_path, capsys):
    (tmp_path / "raw").mkdir()
    np.savez(tmp_path / "raw" / "a.npz", states=np.random.default_rng(0).normal(size=(30, 2)), control_hz=9.0)
    assert koap("convert", tmp_path / "raw", "--action-dim", "1", "--out", tmp_path / "arm") == 0
    assert re.search("next +add actions to a few recordings", capsys.readouterr().out)


def test_a_rate_that_contradicts_the_time_stamps_gives_a_warning(tmp_path, capsys):
    rows = "".join(f"{frame / 100},{frame % 7}\n" for frame in range(30))
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "a.csv").write_text(f"time,x\n{rows}")
    given = ("--action-dim", "1", "--control-hz", "20", "--out", tmp_path / "arm")
    assert koap("convert", tmp_path / "raw", *given) == 0
    assert re.search(r"warning \d +column 'time' \(it says 100 frames", capsys.readouterr().out)


def test_frames_that_another_format_does_not_hold_are_named(tmp_path, capsys):
    raw = write_filmed(tmp_path / "raw", trajectories=1)
    assert koap("convert", raw, "--to", "npz", "--out", tmp_path / "plain") == 0
    assert re.search("cameras +top, wrist: frames are not written", capsys.readouterr().out)


def test_a_data_set_is_not_written_among_recordings(tmp_path, capsys):
    rows = np.random.default_rng(0).normal(size=(30, 2))
    np.savez(tmp_path / "a.npz", states=rows, actions=rows[:-1])
    for words in (("convert", tmp_path, "--control-hz", "30"), ("embed", tmp_path), ("demos",)):
        assert "holds a data set, recordings or a run already; choose another --out" in fails(
            capsys, *words, "--out", tmp_path
        )
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_a_folder_that_exists_is_refused_before_anything_is_read(tmp_path, capsys):
    missing = tmp_path / "raw"
    said = fails(capsys, "convert", missing, "--to", "npz", "--out", tmp_path)
    assert "exists already; choose another folder" in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "arm is a data set of this library already: name another format by --to"),
        (("--to", "npz", "--control-hz", 5), "control_hz .*: not an option for a data set of this library"),
        (("--to", "npz", "--robot", "q1"), "--robot was given, but format 'npz' does not hold it"),
        (("--to", "npz", "--action-kind", "delta"), "--action-kind was given"),
    ],
)
def test_options_of_which_nothing_would_be_kept_are_refused(arm, tmp_path, options, message, capsys):
    assert koap("convert", arm, "--out", tmp_path / "x", *options) == 1
    assert re.search(message, capsys.readouterr().err) and not (tmp_path / "x").exists()


def test_validation_says_how_many_labels_there_are(arm, tmp_path, capsys):
    assert koap("validate", arm) == 0
    assert re.search(r"labelled steps +58\b", capsys.readouterr().out)
    save_demonstrations(tmp_path / "bare", [np.random.default_rng(0).normal(size=(9, 2))], control_hz=9, action_dim=1)
    assert koap("validate", tmp_path / "bare") == 0
    assert re.search(r"labelled steps +none: `koap train` needs a few", capsys.readouterr().out)


@pytest.mark.filterwarnings("ignore:action 'action_1'")
def test_quiet_conversion_still_warns(tmp_path, capsys):
    frames = np.random.default_rng(0).normal(size=(30, 2)).cumsum(0)
    frames[15:, 1] += 1000
    np.savez(tmp_path / "a.npz", states=frames, actions=np.diff(frames, axis=0))
    with pytest.warns(UserWarning, match=r"columns leap: 'state_1'"):
        assert koap("convert", tmp_path, "--out", tmp_path / "arm", "--control-hz", "30", "--quiet") == 0
    assert capsys.readouterr().out == ""


def test_validate_names_the_files(tmp_path, capsys):
    folder = write_demonstrations(tmp_path / "data")
    assert koap("validate", folder) == 0
    assert "no problem found\n" in capsys.readouterr().out
    shutil.copy(folder / "env_000_00.pkl", folder / "env_900_00.pkl")
    assert koap("validate", folder) == 0
    said = capsys.readouterr().out
    assert "env_900_00.pkl repeats" in said and "no problem found, 1 warning(s)" in said


READER = """
import numpy as np
from torchrl_koap.data.formats import FORMATS, Format, make_recordings

FORMATS["text"] = Format(
    "a text of numbers", lambda source: source.endswith(".txt"),
    lambda source: make_recordings([np.loadtxt(source)], action_dim=1, control_hz=30.0),
)
"""


def test_a_plugin_adds_a_format(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS))
    (tmp_path / "reader.py").write_text(READER)
    np.savetxt(tmp_path / "walk.txt", np.random.default_rng(0).normal(size=(30, 2)))
    words = ("convert", tmp_path / "walk.txt", "--out", tmp_path / "walk")
    assert "holds no recordings that can be read" in fails(capsys, *words)
    assert koap(*words, "--plugin", tmp_path / "reader.py") == 0
    assert load_ted(tmp_path / "walk" / "ted")[0]["observation"].shape == (29, 2)
