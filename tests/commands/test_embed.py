# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the path from camera frames to actions: convert, embed, train, and commands that read frames afterwards."""

import json
import shlex

import numpy as np
import pytest
from camera_sets import write_filmed
from tiny_runs import TINY, koap

from torchrl_koap import Agent, Trained, load_policy
from torchrl_koap.data.ted import load_ted
from torchrl_koap.evaluation import loop_on_labels
from torchrl_koap.runs.run_directory import copy_run
from torchrl_koap.runs.weights import CheckpointError

EMBED = ("--network", "tiny_network:random_layer", "--components", "5", "--quiet")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("filmed")
    write_filmed(folder / "raw", cameras=("top",), length=40)
    assert koap("convert", folder / "raw", "--out", folder / "own", "--quiet") == 0
    assert koap("embed", folder / "own", "--camera", "top", "--out", folder / "seen", *EMBED) == 0
    assert koap("train", "--dataset", folder / "seen", "--out", folder / "run", *TINY, "--quiet") == 0
    return folder / "run"


def test_each_step_names_the_next_and_says_what_is_kept(tmp_path, capsys):
    write_filmed(tmp_path / "raw")
    assert koap("convert", tmp_path / "raw", "--out", tmp_path / "own") == 0
    said = capsys.readouterr().out
    next_call = f"koap embed {tmp_path}/own --camera top --camera wrist --out {tmp_path}/own_seen"
    assert "top, wrist" in said and next_call in said
    assert koap("embed", tmp_path / "own", "--out", tmp_path / "seen", *EMBED[:-1]) == 0
    said = capsys.readouterr().out
    for camera in ("top", "wrist"):
        line = next(line for line in said.splitlines() if line.startswith(f"camera {camera}"))
        assert "16 x 24, 5 components keep" in line and "reconstruction error" in line
    assert f"koap train --dataset {tmp_path}/seen --out runs/own" in said


def test_the_next_call_works_with_a_blank_in_the_name(tmp_path, capsys):
    write_filmed(tmp_path / "raw", cameras=("top",))
    assert koap("convert", tmp_path / "raw", "--out", tmp_path / "own", "--name", "my arm", "--quiet") == 0
    assert koap("embed", tmp_path / "own", "--out", tmp_path / "seen", *EMBED[:-1]) == 0
    call = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert call == ["next", "koap", "train", "--dataset", str(tmp_path / "seen"), "--out", "runs/my arm"]


def test_a_robot_gives_numbers_and_frames_to_run_and_file(run, tmp_path):
    data, _ = load_ted(run.parent / "seen" / "ted")
    given = {
        "state": np.load(run.parent / "raw" / "03.npz")["states"][0],
        "top": np.load(run.parent / "raw" / "03" / "top.npy")[0],
    }
    wanted = Agent(load_policy(run), seed=1)
    wanted.reset()
    action = wanted.act(data["observation"][data["episode"] == 3][0].numpy())
    file = Trained.load(run).save(tmp_path / "policy.safetensors")
    for policy in (load_policy(run), Trained.load(file, plugins=["tiny_network"]).policy()):
        agent = Agent(policy, seed=1)
        agent.reset()
        np.testing.assert_allclose(agent.act(given), action, rtol=1e-3, atol=1e-4)
    with pytest.raises(CheckpointError, match="embeds frames with code of tiny_network: name it in plugins"):
        Trained.load(file)


def test_a_plugin_is_taken_for_a_network_s_file_that_lies_elsewhere(run, tmp_path, monkeypatch):
    trained = Trained.load(run)
    trained.cameras["top"].about["network"] = "/elsewhere/net.py:random_layer"
    file = trained.save(tmp_path / "policy.safetensors")
    (tmp_path / "net.py").write_text("from tiny_network import random_layer\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match="embeds frames with code of net.py: name it in plugins"):
        Trained.load(file)
    loaded = Trained.load(file, plugins=["net.py"])
    assert loaded.cameras["top"].about["network"] == f"{tmp_path}/net.py:random_layer"
    assert loaded.policy().observe.example()["top"].shape == (16, 24, 3)
    with pytest.raises(ValueError, match="network: module '/elsewhere/net.py' cannot be imported"):
        trained.policy()
    monkeypatch.setattr(loop_on_labels, "_EXPLAINED", -1)
    monkeypatch.setattr(loop_on_labels, "_DRIFT", 1e9)
    assert loop_on_labels.check_loop(trained, trained.data(), trained.data())["robots"] == 12  # its data are embedded


def test_an_environment_gives_its_pictures(run, tmp_path):
    options = ("--env", "toy_gym:ToySeen-v0", "--episodes", "2", "--no-report", "--out", tmp_path / "eval", "--quiet")
    with pytest.warns(UserWarning, match="frames are 8 x 8, recorded were 16 x 24: they are resized"):
        assert koap("eval", run, *options) == 0
    assert len(json.loads((tmp_path / "eval" / "eval.json").read_text())["episode"]) == 2


def test_a_run_that_was_copied_takes_frames(run, tmp_path):
    assert list(Trained.load(copy_run(run, tmp_path / "copy")).cameras) == ["top"]


def test_a_file_with_a_network_of_one_s_own_needs_its_plugin_to_be_exported_and_says_that_it_takes_embeddings(
    run, tmp_path, capsys
):
    file = Trained.load(run).save(tmp_path / "policy.safetensors")
    assert koap("export", file, "--out", tmp_path / "exported") == 1
    assert "embeds frames with code of tiny_network: name it in plugins" in capsys.readouterr().err
    assert koap("export", file, "--out", tmp_path / "exported", "--plugin", "tiny_network") == 0
    note = "Columns of top are embeddings: the file takes no frames."
    assert note in capsys.readouterr().out
    assert json.loads((tmp_path / "exported" / "policy.json").read_text())["note"].endswith(note)


def test_latency_is_that_with_the_cameras(run, capsys):
    assert koap("latency", run, "--steps", "3") == 0
    printed = capsys.readouterr().out
    assert "of 3;" in printed and "99 % below" in printed
