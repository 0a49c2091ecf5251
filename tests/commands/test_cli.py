# This source code is licensed under the MIT license found in the LICENSE file.
"""The commands: their contract, bit-exact resuming, label budgets that do not leak, and bad input in one line."""

from __future__ import annotations

import errno
import importlib.util
import json
import os
import pickle
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_runs import TINY, grid, koap, write_demonstrations

import torchrl_koap
from torchrl_koap.commands.cli import HINT
from torchrl_koap.data import LabelBudget
from torchrl_koap.tasks import get_task
from torchrl_koap.training import checkpoints
from torchrl_koap.training.builders import build_controller
from torchrl_koap.training.checkpoints import load_tensors, save_tensors
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.run_directory import RunDirectory

TASK = get_task("avoiding")
WEIGHTS = ("planner.safetensors", "controller.safetensors")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def fails(capsys, *arguments) -> str:
    """The one line that a command which cannot be done writes to stderr."""
    capsys.readouterr()
    assert koap(*arguments) == 1
    out, err = capsys.readouterr()
    lines = err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("koap: ") and "Traceback" not in err, err
    assert out == ""
    return lines[0]


@pytest.fixture
def copied_run(trained_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained_run, folder)
    return folder


@pytest.fixture
def no_report(monkeypatch):
    """Rollouts without pictures, which have tests of their own."""
    monkeypatch.setattr("torchrl_koap.commands.eval.write_report", lambda *arguments, **options: None)


# koap train


def test_what_a_training_writes(trained_run, demonstrations):
    config, summary = (json.loads((trained_run / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert config["dataset"] == str(demonstrations) and config["steps"] == 20 and config["channels"] == [8, 16]
    assert config["planner"]["horizon"] == 14
    assert config["controller"]["method"] == "koap" and config["controller"]["state"] == "robot"
    assert config["versions"]["torch"] == torch.__version__
    assert summary["labels"]["selected_units"] == 2 and summary["labels"]["trajectories_touched"] == 2
    assert summary["labels"]["total_transitions"] == sum(29 + index for index in range(8))
    controller = build_controller(config["controller"], 2, 2)
    unseen = 2 * (controller.num_window_frames - 1 - controller.num_past)  # the ends of two trajectories
    assert summary["decoder_fit"]["labels_used"] == summary["labels"]["labelled_transitions"] - unseen
    assert summary["action_error_mm"]["controller"] > 0 and summary["action_error_mm"]["ridge"] > 0
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
    assert all(torch.equal(kept[name], state[f"loss.target_planner_params.{name}"]) for name in weights)
    assert any(not torch.equal(kept[name], state[f"loss.planner_params.{name}"]) for name in weights)


def test_the_same_seed_gives_the_same_run_another_seed_another(trained_run, demonstrations, tmp_path):
    for seed in (0, 1):
        assert koap("train", "--out", tmp_path / str(seed), "--dataset", demonstrations, *TINY, "--seed", seed) == 0
    for name in WEIGHTS:
        assert (tmp_path / "0" / name).read_bytes() == (trained_run / name).read_bytes()
        assert (tmp_path / "1" / name).read_bytes() != (trained_run / name).read_bytes()


def test_a_planner_taken_over_changes_nothing_in_the_controller(trained_run, demonstrations, tmp_path):
    out = tmp_path / "run"
    assert koap("train", "--out", out, "--dataset", demonstrations, *TINY, "--planner-from", trained_run) == 0
    for name in WEIGHTS:
        mine, its = load_tensors(out / name)[0], load_tensors(trained_run / name)[0]
        assert mine.keys() == its.keys() and all(torch.equal(mine[key], its[key]) for key in mine)
    assert json.loads((out / "config.json").read_text())["planner_from"] == str(trained_run)
    assert {row["phase"] for row in RunDirectory(out).read_metrics()} == {"controller"}


LONG = [*TINY, "--steps", "60", "--controller-steps", "60", "--no-analysis"]


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


@pytest.mark.parametrize("phase", ["planner", "controller"])
@pytest.mark.parametrize("checkpoint_every", [20, 1000])
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

    command = ["train", "--out", out, "--dataset", demonstrations, *LONG, "--checkpoint-every", checkpoint_every]
    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "log", killed)
        assert koap(*command) == 130
    assert "koap: interrupted" in capsys.readouterr().err
    assert not (out / "controller.safetensors").exists()
    assert (out / "planner.safetensors").exists() == (phase == "controller")
    steps = []
    monkeypatch.setattr(RunDirectory, "log", lambda self, n, s, v: steps.append((n, s)) or log(self, n, s, v))
    assert koap("train", "--out", out, "--resume", "--checkpoint-every", checkpoint_every) == 0
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
        (2, "trajectory", ()),
        (2, "window", ("--decoder", "sgd")),
        (30, "transition", ("--method", "dd", "--controller-steps", "5")),
        (2, "trajectory", ("--preset", "paper")),
        (3, "window", ("--method", "linear")),
    ],
)
def test_nothing_outside_the_label_budget_reaches_planner_or_controller(
    amount, unit, options, demonstrations, tmp_path
):
    budget = LabelBudget(amount, unit=unit, seed=0, window=16, history=2)
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
        arguments = ["--label-unit", unit, *options, "--no-analysis", "--label-count", amount]
        assert koap("train", "--out", tmp_path / name, "--dataset", folder, *TINY, *arguments) == 0
    files = {name: [(tmp_path / name / file).read_bytes() for file in WEIGHTS] for name in folders}
    assert files["outside"] == files["clean"]
    assert files["inside"][0] == files["clean"][0]  # the planner never sees an action
    assert files["inside"][1] != files["clean"][1]  # else the test could not fail
    reports = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("clean", "outside")]
    assert settled(reports[0]) == settled(reports[1])


# koap eval


def test_what_an_evaluation_writes(copied_run, capsys):
    """The contract of eval.json, a report with pictures, and numbers that depend on the seeds alone."""
    assert koap("eval", copied_run, "--episodes", 3, "--seed", 100, "--threads", 1, "--no-animate") == 0
    result = json.loads((copied_run / "eval.json").read_text())
    rows = result["episode"]
    assert [row["seed"] for row in rows] == [100, 101, 102]
    assert {row["outcome"] for row in rows} <= {"success", "collision", "timeout"}
    won = sum(row["outcome"] == "success" for row in rows)
    assert result["success_rate"] == won / 3 and result["episodes"] == 3
    assert 0 <= result["success_low"] <= result["success_rate"] <= result["success_high"] <= 1
    assert result["collisions"] == sum(row["outcome"] == "collision" for row in rows)
    assert result["mean_steps"] == pytest.approx(sum(row["steps"] for row in rows) / 3)
    assert all(-1 <= row["mode"] < 24 for row in rows) and 0 <= result["mode_entropy"] <= 1
    assert result["control_hz"] > 0 and result["plan_ms"] >= 0 and result["control_ms"] > 0
    assert (result["execution"], result["replan_interval"]) == ("feedback", 4)
    tensors, about = load_tensors(copied_run / "rollouts.safetensors")
    assert tensors["length"].tolist() == [row["steps"] for row in rows] and about["task"] == "avoiding"
    assert (copied_run / "index.html").stat().st_size > 1000
    assert "success_rate" in capsys.readouterr().out


def test_an_evaluation_does_not_depend_on_the_batch_size(copied_run, no_report):
    found = []
    for size in (8, 3):
        assert koap("eval", copied_run, "--episodes", 8, "--seed", 7, "--threads", 1, "--batch-size", size) == 0
        result = json.loads((copied_run / "eval.json").read_text())
        found.append((result["episode"], load_tensors(copied_run / "rollouts.safetensors")[0]["position"]))
    assert found[0][0] == found[1][0]
    torch.testing.assert_close(found[0][1], found[1][1], atol=1e-4, rtol=0, equal_nan=True)


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (("--execution", "open_loop"), {"execution": "open_loop"}),
        (("--solver", "ddpm", "--solver-steps", "4"), {"solver": "ddpm", "solver_steps": 4}),
        (("--replan-interval", "2"), {"replan_interval": 2}),
    ],
)
def test_options_of_an_evaluation(copied_run, no_report, options, wanted):
    assert koap("eval", copied_run, "--episodes", 1, "--threads", 1, *options) == 0
    result = json.loads((copied_run / "eval.json").read_text())
    assert {key: result[key] for key in wanted} == wanted and result["episodes"] == 1


# bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--task", "avoidin"), "unknown task 'avoidin'; did you mean 'avoiding'?"),
        (("--method", "kaop"), "unknown method 'kaop'; did you mean 'koap'?"),
        (("--preset", "papper"), "unknown preset 'papper'; did you mean 'paper'?"),
        (("--decoder", "rigde"), "unknown decoder 'rigde'; did you mean 'ridge'?"),
        (("--method", "linear", "--decoder", "sgd"), "method 'linear' is a closed form: it has no decoder 'sgd'"),
        (("--denoiser", "unnet"), "unknown denoiser 'unnet'; did you mean 'unet'?"),
        (("--schedule", "linaer"), "unknown schedule 'linaer'; did you mean 'linear'?"),
        (("--prediction", "smaple"), "unknown prediction 'smaple'; did you mean 'sample'?"),
        (("--solver", "dmp++2m"), "unknown solver 'dmp++2m'; did you mean 'dpm++2m'?"),
        (("--solver", "euler"), "solver 'euler' walks a flow path"),
        (("--solver-steps", "0"), "num_steps must lie in 1..50"),
        (("--logger", "wandbb"), "unknown logger 'wandbb'; did you mean 'wandb'?"),
        (("--label-unit", "trajectries"), "unknown unit 'trajectries'; did you mean 'trajectory'?"),
        (("--label-count", "None", "--label-fraction", "0.01"), "a label fraction of 0.01 selects none of the 8"),
        (("--label-count", "None", "--label-fraction", "1.5"), "a fraction must be in (0, 1], got 1.5"),
        (("--label-count", "0"), "a count of labelled units must be at least 1, got 0"),
        (("--label-count", "9"), "9 labelled trajectories asked for, there are 8"),
        (("--dataset", "nowhere"), "dataset 'nowhere' is neither 'scripted' nor a folder"),
        (("--dataset", "scripted", "--episodes", "0"), "episodes must be an integer of at least 1, got 0"),
        (("--steps", "0"), "steps must be >= 1"),
        (("--batch-size", "0"), "batch_size must be >= 1, got 0"),
        (("--checkpoint-every", "0"), "checkpoint_every must be >= 1, got 0"),
        (("--threads", "0"), "threads must be >= 1, got 0"),
        (("--device", "gpu"), "device must be 'cpu' or 'cuda', got 'gpu'"),
        (("--planner-from", "nowhere"), "config.json is missing: is nowhere the folder of a finished"),
    ],
)
def test_a_training_that_cannot_be_done_leaves_nothing_behind(options, message, demonstrations, tmp_path, capsys):
    out = tmp_path / "run"
    if "scripted" in options:  # its progress bar is on stderr too
        assert koap("train", "--out", out, "--dataset", demonstrations, *TINY, *options) == 1
        line = capsys.readouterr().err.strip().splitlines()[-1]
    else:
        line = fails(capsys, "train", "--out", out, "--dataset", demonstrations, *TINY, *options)
    assert message in line
    assert not out.exists()


class Hostile:
    def __reduce__(self):
        return os.system, ("touch owned",)


def damage(folder: Path, kind: str) -> None:
    file = folder / "env_003_00.pkl"
    content = pickle.loads(file.read_bytes())
    if kind == "hostile":
        content["context"] = Hostile()
    elif kind == "nan":
        content["robot"]["c_pos"][4, 1] = np.nan
    elif kind == "infinite":
        content["robot"]["des_c_pos"][2, 0] = np.inf
    elif kind == "lengths":
        content["robot"]["c_pos"] = content["robot"]["c_pos"][:-1]
    elif kind == "key":
        del content["robot"]["des_c_pos"]
    elif kind == "short":
        content["robot"] = {key: value[:9] for key, value in content["robot"].items()}
    data = pickle.dumps(content, protocol=4)
    file.write_bytes({"truncated": data[:200], "empty": b""}.get(kind, data))


DAMAGES = {
    "hostile": "env_003_00.pkl",
    "nan": "'robot/c_pos' is NaN or infinite in 1 values, first in row 4",
    "infinite": "'robot/des_c_pos' is NaN or infinite in 1 values, first in row 2",
    "lengths": "unequal lengths: ",
    "key": "missing key 'robot/des_c_pos'",
    "truncated": "env_003_00.pkl",
    "empty": "env_003_00.pkl",
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_bad_demonstrations_are_named_before_anything_runs(kind, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = write_demonstrations(tmp_path / "data")
    damage(folder, kind)
    for command in (["train", "--out", tmp_path / "run", "--dataset", folder, *TINY], ["validate", folder]):
        line = fails(capsys, *command)
        assert DAMAGES[kind] in line and "env_003_00.pkl" in line
    assert not (tmp_path / "run").exists() and not (tmp_path / "owned").exists()


@pytest.mark.parametrize("options", [(), ("--method", "linear"), ("--preset", "paper", "--no-analysis")])
def test_trajectories_too_short_for_a_window_are_named_before_the_planner_is_trained(options, tmp_path, capsys):
    folder = write_demonstrations(tmp_path / "data")
    damage(folder, "short")
    line = fails(capsys, "train", "--out", tmp_path / "run", "--dataset", folder, *TINY, *options)
    assert "1 of 8 trajectories are shorter than a window" in line and "3 (8 steps)" in line
    assert not (tmp_path / "run").exists()


def test_a_folder_without_demonstrations_is_named(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    line = fails(capsys, "train", "--out", tmp_path / "run", "--dataset", tmp_path / "data", *TINY)
    assert f"no demonstrations (*.pkl) in {tmp_path / 'data'}" in line


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "holds a run already; choose another --out, or --resume it"),
        (("--resume", "--seed", "3"), "was started with another seed; it cannot be resumed so"),
        (("--resume", "--steps", "30", "--preset", "paper"), "was started with another preset, steps, controller"),
    ],
)
def test_an_earlier_run_is_not_touched(options, message, copied_run, demonstrations, capsys):
    before = contents(copied_run)
    arguments = ["--dataset", demonstrations, *TINY] if "--resume" not in options else []
    assert message in fails(capsys, "train", "--out", copied_run, *arguments, *options)
    assert contents(copied_run) == before


def edit_json(path, **entries):
    content = {**json.loads(path.read_text()), **entries}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def edit_weights(path, *, drop="", **about):
    tensors, facts = load_tensors(path)
    kept = {name: value for name, value in tensors.items() if not (drop and drop in name)}
    assert not drop or len(kept) < len(tensors)
    save_tensors(path, kept, {**facts, **about})


BROKEN_RUNS = {
    "another task": (
        lambda run: edit_weights(run / "planner.safetensors", task="sorting"),
        "planner.safetensors was trained on task 'sorting', not on 'avoiding'",
    ),
    "no statistics of the planner": (
        lambda run: edit_weights(run / "planner.safetensors", drop="plan_normalizer"),
        '"plan_normalizer.offset"',
    ),
    "no statistics of the controller": (
        lambda run: edit_weights(run / "controller.safetensors", drop="action_normalizer"),
        "action_normalizer.offset",
    ),
    "truncated weights": (
        lambda run: os.truncate(run / "controller.safetensors", 5000),
        "controller.safetensors is damaged",
    ),
    "no weights": (lambda run: (run / "planner.safetensors").unlink(), "planner.safetensors is missing"),
    "no config": (lambda run: (run / "config.json").unlink(), "config.json is missing: is "),
    "damaged config": (lambda run: os.truncate(run / "config.json", 100), "config.json is damaged"),
    "incomplete config": (
        lambda run: edit_json(run / "config.json", planner=None),
        "config.json has no entry 'planner'",
    ),
    "unknown task": (
        lambda run: edit_json(run / "config.json", task="avoidingg"),
        "unknown task 'avoidingg'; did you mean 'avoiding'?",
    ),
    "other sizes": (
        lambda run: edit_json(
            run / "config.json",
            planner={**json.loads((run / "config.json").read_text())["planner"], "channels": [8, 24]},
        ),
        "planner.safetensors does not fit the model",
    ),
}


@pytest.mark.parametrize("kind", BROKEN_RUNS)
def test_a_run_that_cannot_be_evaluated_is_named(kind, copied_run, capsys):
    (copied_run / "eval.json").write_text("an earlier result")
    breaks, message = BROKEN_RUNS[kind]
    breaks(copied_run)
    before = contents(copied_run)
    assert message in fails(capsys, "eval", copied_run, "--episodes", 1, "--threads", 1)
    assert contents(copied_run) == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--execution", "openloop"), "unknown execution 'openloop'; did you mean 'open_loop'?"),
        (("--solver", "dmp"), "unknown solver 'dmp'"),
        (("--solver", "heun"), "solver 'heun' walks a flow path"),
        (("--solver-steps", "51"), "num_steps must lie in 1..50"),
        (("--replan-interval", "15"), "replan_interval must be in 1..14"),
        (("--episodes", "0"), "episodes must be >= 1, got 0"),
        (("--batch-size", "0"), "batch_size must be >= 1, got 0"),
        (("--threads", "0"), "threads must be >= 1, got 0"),
        (("--task", "sorting"), "was trained on task 'avoiding', not on 'sorting'"),
    ],
)
def test_an_evaluation_that_cannot_be_done_leaves_the_run_alone(options, message, copied_run, capsys):
    before = contents(copied_run)
    assert message in fails(capsys, "eval", copied_run, *options)
    assert contents(copied_run) == before


def test_a_missing_run_folder_is_named(tmp_path, capsys):
    line = fails(capsys, "eval", tmp_path / "nothing")
    assert f"{tmp_path / 'nothing' / 'config.json'} is missing" in line
    assert list(tmp_path.iterdir()) == []


def full_disk(*arguments, **options):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("place", ["weights", "rename"])
def test_a_full_disk_damages_no_earlier_result_of_a_training(place, copied_run, monkeypatch, capsys):
    before = contents(copied_run)
    monkeypatch.setattr(*((checkpoints, "save_file") if place == "weights" else (os, "replace")), full_disk)
    assert koap("train", "--out", copied_run, "--resume") == 1
    err = capsys.readouterr().err
    assert err.strip().splitlines()[-1].startswith("koap: ") and "No space left on device" in err
    assert "Traceback" not in err
    after = contents(copied_run)
    assert after.keys() == before.keys()
    assert [name for name in before if after[name] != before[name]] in ([], ["config.json"])
    assert json.loads(after["config.json"])["steps"] == 20


def test_a_full_disk_damages_no_earlier_evaluation(copied_run, monkeypatch, capsys, no_report):
    assert koap("eval", copied_run, "--episodes", 1, "--threads", 1) == 0
    before = contents(copied_run)
    monkeypatch.setattr(os, "replace", full_disk)
    assert koap("eval", copied_run, "--episodes", 2, "--threads", 1) == 1
    line = capsys.readouterr().err.strip().splitlines()[-1]
    where = f"{copied_run / 'rollouts.safetensors'} could not be written: No space left on device"
    assert line == f"koap: [Errno 28] {where}; what was there before is kept ({HINT})"
    assert contents(copied_run) == before


def test_where_an_error_is_from_is_shown_on_request(monkeypatch):
    monkeypatch.setenv("KOAP_TRACEBACK", "1")
    with pytest.raises(ValueError, match="unknown task"):
        koap("train", "--out", "x", "--task", "none")


# calls


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["train", "--out", "x", "--lable-fraction", "0.1"], "--label-fraction"),
        (["eval", "x", "--episode", "3"], "--episodes"),
        (["train"], "--out"),
        (["trian"], "train"),
        ([], "train"),
        (["train", "--out", "x", "--steps", "many"], "--steps"),
    ],
)
def test_a_wrong_call_leaves_with_2_and_a_hint(arguments, hint, capsys):
    with pytest.raises(SystemExit) as left:
        koap(*arguments)
    assert left.value.code == 2
    out, err = capsys.readouterr()
    assert hint in err and "Traceback" not in err and out == ""


def test_as_a_program(tmp_path):
    """Through the installed entry point: exit status, one line on stderr, and a doctor who finds the versions."""
    program = Path(sys.executable).with_name("koap")
    command = [str(program)] if program.exists() else [sys.executable, "-m", "torchrl_koap.commands.cli"]
    wrong = subprocess.run([*command, "eval", str(tmp_path / "none")], capture_output=True, text=True)
    assert wrong.returncode == 1 and wrong.stdout == ""
    missing = f"{tmp_path}/none/config.json is missing: is {tmp_path}/none the folder of a finished `koap train`?"
    assert wrong.stderr == f"koap: {missing} ({HINT})\n"


def test_doctor_lists_versions(capsys):
    assert koap("doctor") == 0
    lines = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines())
    assert lines["torch"].strip() == torch.__version__ and lines["torchrl_koap"].strip() == "0.1.0"
    assert "MISSING" not in str(lines)
    assert {"python", "processors", "CUDA", "mujoco", "extra wandb"} <= lines.keys()


def test_demonstrations_are_recorded_once_and_are_sound(tmp_path, capsys):
    assert koap("demos", "--out", tmp_path / "demos", "--episodes", 2, "--seed", 4) == 0
    assert "2 demonstrations of avoiding" in capsys.readouterr().out
    assert len(list((tmp_path / "demos" / "raw").glob("*.pkl"))) == 2
    before = contents(tmp_path / "demos")
    assert "ted exists already; choose another --out" in fails(capsys, "demos", "--out", tmp_path / "demos")
    assert contents(tmp_path / "demos") == before
    counts = []
    for folder in (tmp_path / "demos", tmp_path / "demos" / "raw"):
        assert koap("validate", folder) == 0
        counts.append(capsys.readouterr().out)
    assert "no problem found" in counts[0] and counts[0] == counts[1]


@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="wandb is not installed")
def test_wandb_stays_on_this_machine(demonstrations, tmp_path, monkeypatch):
    """Offline unless asked otherwise: a server at the configured address hears nothing, the log is in the run."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        monkeypatch.delenv("WANDB_MODE", raising=False)
        monkeypatch.setenv("WANDB_BASE_URL", f"http://127.0.0.1:{server.getsockname()[1]}")
        monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
        monkeypatch.setenv("WANDB_SILENT", "true")
        out = tmp_path / "run"
        assert koap("train", "--out", out, "--dataset", demonstrations, *TINY, "--logger", "wandb") == 0
        with pytest.raises(TimeoutError):
            server.accept()
    (log,) = (out / "wandb").glob("offline-run-*/*.wandb")
    assert log.stat().st_size > 500
    assert len(RunDirectory(out).read_metrics()) == 2


def test_films_of_an_evaluation_go_to_wandb_on_this_machine(copied_run, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.chdir(tmp_path)

    def report(folder, *, animation):
        pictures = [Image.new("RGB", (9, 7), color) for color in ("red", "blue")]
        (folder / "plots").mkdir()
        pictures[0].save(folder / "plots" / "rollouts.gif", save_all=True, append_images=pictures[1:])

    monkeypatch.setattr("torchrl_koap.commands.eval.write_report", report)
    assert koap("eval", copied_run, "--episodes", "1", "--threads", "1", "--logger", "wandb") == 0
    film = (copied_run / "plots" / "rollouts.gif").read_bytes()
    logged = [path for path in (copied_run / "wandb").rglob("*") if path.is_file()]
    assert any(path.suffix == ".gif" and path.read_bytes() == film for path in logged)
    assert any(b"eval/success_rate" in path.read_bytes() for path in logged)
    assert not (tmp_path / "wandb").exists()


def test_wandb_that_is_not_installed_names_the_extra(demonstrations, tmp_path, monkeypatch, capsys):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "wandb" else find_spec(name, *rest)
    )
    command = ["train", "--out", tmp_path / "run", "--dataset", demonstrations, *TINY, "--logger", "wandb"]
    assert "pip install 'torchrl_koap[wandb]'" in fails(capsys, *command)
    assert not (tmp_path / "run").exists()


# what every command has


def test_version(capsys):
    assert koap("--version") == 0
    assert capsys.readouterr().out == f"koap {torchrl_koap.__version__}\n"


def test_quiet_says_nothing_but_what_went_wrong(demonstrations, tmp_path, capsys):
    command = ("train", "--out", tmp_path / "run", "--dataset", demonstrations, *TINY, "--quiet")
    assert koap(*command) == 0
    assert capsys.readouterr() == ("", "")
    assert "holds a run already" in fails(capsys, *command)


def test_two_trainings_in_one_folder(copied_run, capsys):
    """The second one is refused while the first one works, and leaves the folder alone."""
    with RunDirectory(copied_run).locked("koap train"):
        before = contents(copied_run)
        line = fails(capsys, "train", "--out", copied_run, "--resume")
        assert f"another `koap train` is working in {copied_run}" in line
        assert contents(copied_run) == before


def test_two_trainings_that_begin_together(demonstrations, tmp_path, capsys, monkeypatch):
    """Both found a new folder; while one reads its demonstrations the other one begins, or is through."""
    from torchrl_koap.training import run

    out, load = tmp_path / "run", run.load_demonstrations
    command = ("train", "--out", out, "--dataset", demonstrations, *TINY, "--quiet")

    def meanwhile(*arguments, **options):
        monkeypatch.setattr(run, "load_demonstrations", load)
        assert koap(*command) == 0
        return load(*arguments, **options)

    monkeypatch.setattr(run, "load_demonstrations", meanwhile)
    assert "holds a run already" in fails(capsys, *command)
    assert (out / "summary.json").exists()


def test_every_error_line_says_how_to_see_more(capsys, tmp_path):
    assert fails(capsys, "eval", tmp_path).endswith("(KOAP_TRACEBACK=1 shows where)")
