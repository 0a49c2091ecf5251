# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests ``koap train``: written files, effects of the seed, reused planners, finished runs."""

import json
import shutil
import sys
from importlib.metadata import version
from unittest.mock import Mock

import torch
from command_calls import contents
from tiny_runs import TINY, koap

from torchrl_koap.commands import run_commands
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.training import Trained

WEIGHTS = ("planner.safetensors", "controller.safetensors")


def test_what_a_training_writes(trained_run, demonstrations):
    config, summary = (json.loads((trained_run / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert config["dataset"] == str(demonstrations)
    assert config["planner"]["steps"] == 20 and config["planner"]["width"] == 8
    assert config["method"] == "koap" and config["controller"]["columns"] == "robot"
    assert config["versions"]["torch"] == version("torch")
    assert summary["labels"]["selected_units"] == 2 and summary["labels"]["trajectories_touched"] == 2
    assert summary["labels"]["total_transitions"] == sum(29 + index for index in range(8))
    controller = Trained.load(trained_run).controller
    unseen = 2 * (controller.num_window_frames - 1 - controller.num_past)  # the ends of two trajectories
    assert summary["decoder_fit"]["labels_used"] == summary["labels"]["labelled_transitions"] - unseen
    rows = RunDirectory(trained_run).read_metrics()
    assert [(row["phase"], row["step"]) for row in rows] == [("planner", "20"), ("controller", "20")]
    assert float(rows[0]["loss_planner"]) == summary["planner"]["loss_planner"]
    assert float(rows[1]["loss_koopman"]) == summary["controller"]["loss_koopman"]
    for name in WEIGHTS:
        assert load_tensors(trained_run / name)[1]["task"] == "avoiding"
    assert {".tmp" in name for name in contents(trained_run)} == {False}


def test_the_planner_kept_is_the_moving_average(trained_run):
    state, _ = load_tensors(trained_run / "checkpoints" / "planner.safetensors")
    kept, _ = load_tensors(trained_run / "planner.safetensors")
    weights = [name for name in kept if name.startswith("denoiser.")]
    assert len(weights) > 10
    assert all(torch.equal(kept[name], state[f"loss.target_network_params.{name}"]) for name in weights)
    assert any(not torch.equal(kept[name], state[f"loss.network_params.{name}"]) for name in weights)


def test_another_seed_gives_another_run(trained_run, demonstrations, tmp_path):
    assert koap("train", "--out", tmp_path / "other", "--dataset", demonstrations, *TINY, "--seed", 1) == 0
    for name in WEIGHTS:
        assert (tmp_path / "other" / name).read_bytes() != (trained_run / name).read_bytes()


def test_a_reused_planner_does_not_change_the_controller(trained_run, demonstrations, tmp_path):
    out = tmp_path / "run"
    assert koap("train", "--out", out, "--dataset", demonstrations, *TINY, "--planner.source", trained_run) == 0
    for name in WEIGHTS:
        mine, its = load_tensors(out / name)[0], load_tensors(trained_run / name)[0]
        assert mine.keys() == its.keys() and all(torch.equal(mine[key], its[key]) for key in mine)
    assert json.loads((out / "config.json").read_text())["planner"]["source"] == str(trained_run)
    assert {row["phase"] for row in RunDirectory(out).read_metrics()} == {"controller"}


def test_an_interrupted_training_says_how_to_go_on(copied_run, monkeypatch, capsys):
    monkeypatch.setattr(run_commands, "train", Mock(side_effect=KeyboardInterrupt))

    def said(out):
        assert koap("train", "--out", out) == 130
        return capsys.readouterr().err

    resume = f"koap: interrupted; `koap train --out {copied_run} --resume` "
    assert said(copied_run) == f"{resume}resumes at its last checkpoint\n"
    shutil.rmtree(copied_run / "checkpoints")
    assert said(copied_run) == f"{resume}starts again, as there is no checkpoint yet\n"
    assert said(copied_run / "new") == "koap: interrupted; nothing is trained yet: train again\n"


def test_the_call_is_kept_as_a_shell_reads_it(tmp_path, monkeypatch):
    train = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(run_commands, "train", train)
    monkeypatch.setattr(sys, "argv", ["koap", "train", "--out", "my arm"])
    koap("train", "--out", tmp_path / "my arm")
    assert train.call_args.kwargs["command"] == "koap train --out 'my arm'"


def test_resuming_a_finished_run_does_not_change_it(copied_run, monkeypatch):
    before = contents(copied_run)
    began = RunDirectory(copied_run).read_json("config.json")["command"]
    monkeypatch.setattr(sys, "argv", ["koap", "train", "--resume"])
    assert koap("train", "--out", copied_run, "--resume") == 0
    assert RunDirectory(copied_run).read_json("config.json")["command"] == began  # which says what the run is
    after = contents(copied_run)
    assert after.keys() == before.keys()
    for name in before:
        if name != "config.json":
            assert after[name] == before[name], name
