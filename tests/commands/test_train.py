# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap train``: what it writes, bit-exact resuming, label budgets that do not leak."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
from command_calls import contents
from tiny_runs import TINY, grid, koap, write_demonstrations

from torchrl_koap.data import LabelBudget
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import get_task
from torchrl_koap.training import Trained, loop
from torchrl_koap.training.datasets import load_demonstrations

TASK = get_task("avoiding")
WEIGHTS = ("planner.safetensors", "controller.safetensors")


def test_what_a_training_writes(trained_run, demonstrations):
    config, summary = (json.loads((trained_run / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert (
        config["dataset"] == str(demonstrations)
        and config["planner"]["steps"] == 20
        and config["planner"]["width"] == 8
    )
    assert config["method"] == "koap" and config["controller"]["columns"] == "robot"
    assert config["versions"]["torch"] == torch.__version__
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


def test_the_same_seed_gives_the_same_run_another_seed_another(trained_run, demonstrations, tmp_path):
    for seed in (0, 1):
        assert koap("train", "--out", tmp_path / str(seed), "--dataset", demonstrations, *TINY, "--seed", seed) == 0
    for name in WEIGHTS:
        assert (tmp_path / "0" / name).read_bytes() == (trained_run / name).read_bytes()
        assert (tmp_path / "1" / name).read_bytes() != (trained_run / name).read_bytes()


def test_a_planner_taken_over_changes_nothing_in_the_controller(trained_run, demonstrations, tmp_path):
    out = tmp_path / "run"
    assert koap("train", "--out", out, "--dataset", demonstrations, *TINY, "--planner.source", trained_run) == 0
    for name in WEIGHTS:
        mine, its = load_tensors(out / name)[0], load_tensors(trained_run / name)[0]
        assert mine.keys() == its.keys() and all(torch.equal(mine[key], its[key]) for key in mine)
    assert json.loads((out / "config.json").read_text())["planner"]["source"] == str(trained_run)
    assert {row["phase"] for row in RunDirectory(out).read_metrics()} == {"controller"}


LONG = [*TINY, "--steps", "60", "--controller.steps", "60"]


@pytest.fixture(scope="module")
def long_run(tmp_path_factory, demonstrations):
    folder = tmp_path_factory.mktemp("long") / "run"
    assert koap("train", "--out", folder, "--dataset", demonstrations, *LONG) == 0
    return folder


def settled(summary):
    """A summary without what the clock says."""
    summary.pop("train_seconds")
    for phase in ("planner", "controller"):
        summary[phase].pop("iterations_per_second", None)
    return summary


def rows_without_speed(folder):
    rows = RunDirectory(folder).read_metrics()
    return [{key: value for key, value in row.items() if key != "iterations_per_second"} for row in rows]


@pytest.mark.parametrize(("phase", "checkpoint_every"), [("planner", 20), ("controller", 1000)])
def test_a_run_killed_in_the_middle_ends_bit_for_bit_like_one_that_was_not(
    phase, checkpoint_every, long_run, demonstrations, tmp_path, monkeypatch, capsys
):
    """Killed right after the row of step 50 was logged: the last checkpoint is that of step 40, or there is none."""
    out = tmp_path / "run"
    log = RunDirectory.log

    def killed(self, name, step, values):
        log(self, name, step, values)
        if (name, step) == (phase, 50):
            raise KeyboardInterrupt

    command = ["train", "--out", out, "--dataset", demonstrations, *LONG]
    monkeypatch.setattr(loop, "CHECKPOINT_EVERY", checkpoint_every)
    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "log", killed)
        assert koap(*command) == 130
    assert "koap: interrupted" in capsys.readouterr().err
    assert not (out / "controller.safetensors").exists()
    assert (out / "planner.safetensors").exists() == (phase == "controller")
    steps = []
    monkeypatch.setattr(RunDirectory, "log", lambda self, n, s, v: steps.append((n, s)) or log(self, n, s, v))
    assert koap("train", "--out", out, "--resume") == 0
    assert ("planner", 60) in steps if phase == "planner" else ("planner", 60) not in steps
    for name in WEIGHTS:
        assert (out / name).read_bytes() == (long_run / name).read_bytes(), name
    assert rows_without_speed(out) == rows_without_speed(long_run)
    assert settled(RunDirectory(out).read_json("summary.json")) == settled(
        RunDirectory(long_run).read_json("summary.json")
    )


def test_a_finished_run_may_be_resumed_and_stays_what_it_is(copied_run, monkeypatch):
    before = contents(copied_run)
    began = RunDirectory(copied_run).read_json("config.json")["command"]
    monkeypatch.setattr(sys, "argv", ["koap", "train", "--resume"])
    assert koap("train", "--out", copied_run, "--resume") == 0
    assert RunDirectory(copied_run).read_json("config.json")["command"] == began  # which says what the run is
    after = contents(copied_run)
    assert after.keys() == before.keys()
    for name in before:
        if name not in ("config.json", "summary.json"):
            assert after[name] == before[name], name


# label budgets


def hidden_commands_changed(folder, source, budget, *, inside=False):
    """The same measured paths; the actions outside the budget (or inside it) are other ones, with noise and a drift."""
    data = load_demonstrations(str(source), TASK)
    labelled, _ = budget.apply(data)
    shown = labelled["has_action"].squeeze(-1).split(data["episode"].unique(return_counts=True)[1].tolist())
    generator = np.random.default_rng(5)

    def change(index, commanded, measured):
        actions = np.diff(commanded, axis=0)
        poison = grid(generator.normal(0.05, 0.3, actions.shape))
        altered = np.where((shown[index].numpy() == inside)[:, None], actions + poison, actions)
        return np.vstack([commanded[:1], commanded[:1] + np.cumsum(altered, 0)]), measured

    return write_demonstrations(folder, change=change)


@pytest.mark.parametrize(
    ("amount", "unit", "options"),
    [
        (30, "transition", ("--method", "dd", "--controller.steps", "5")),
        (2, "trajectory", ("--preset", "paper", "--controller.steps", "5")),
    ],
)
def test_nothing_outside_the_label_budget_reaches_planner_or_controller(
    amount, unit, options, demonstrations, tmp_path
):
    budget = LabelBudget(count=amount, unit=unit, seed=0)
    folders = {
        "clean": demonstrations,
        "outside": hidden_commands_changed(tmp_path / "data_outside", demonstrations, budget),
        "inside": hidden_commands_changed(tmp_path / "data_inside", demonstrations, budget, inside=True),
    }
    clean, outside = (load_demonstrations(str(folders[name]), TASK) for name in ("clean", "outside"))
    kept = budget.apply(clean)[0]["has_action"].squeeze(-1)
    assert torch.equal(clean["action"][kept], outside["action"][kept])
    assert (clean["action"][~kept] != outside["action"][~kept]).all()
    assert (clean["observation"][:, :2] != outside["observation"][:, :2]).any()
    for name, folder in folders.items():
        arguments = ["--labels.unit", unit, *options, "--labels.count", amount]
        assert koap("train", "--out", tmp_path / name, "--dataset", folder, *TINY, *arguments) == 0
    files = {name: [(tmp_path / name / file).read_bytes() for file in WEIGHTS] for name in folders}
    assert files["outside"] == files["clean"]
    assert files["inside"][0] == files["clean"][0]  # the planner never sees an action
    assert files["inside"][1] != files["clean"][1]  # else the test could not fail
    reports = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("clean", "outside")]
    assert settled(reports[0]) == settled(reports[1])
