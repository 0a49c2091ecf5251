# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests every method through ``koap train``: no weight depends on hidden labels; killed runs resume exactly."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from torchrl_koap import ControllerConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig, Trained, fit, train
from torchrl_koap.data import LabelBudget, make_demonstrations, open_dataset, save_demonstrations
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.runs.weights import CheckpointError, load_tensors
from torchrl_koap.tasks import get_task
from torchrl_koap.training import loop, on_disk
from torchrl_koap.training.methods import METHODS

TASK = get_task("avoiding")
PLANNER = PlannerConfig(steps=4, batch_size=8, width=8)
TINY = {"labels": LabelConfig(count=2), "planner": PLANNER, "controller": ControllerConfig(steps=4)}
POISON = 1e9


@pytest.fixture(scope="module")
def planner(tmp_path_factory, demonstrations):
    """A run whose planner is taken over by all others."""
    folder = tmp_path_factory.mktemp("planner") / "run"
    train(TrainConfig(out=folder, dataset=str(demonstrations), method="linear", **TINY))
    return folder


def train_tiny(out, demonstrations, planner, method, /, **options):
    options = {**TINY, **options}
    if METHODS[method].plans:
        options["planner"] = PlannerConfig(source=planner)
    return train(TrainConfig(out=out, dataset=str(demonstrations), method=method, **options))


def poisoned(data, budget, *, inside=False):
    """Fully labelled data whose actions and commands outside the budget are senseless; or whose labels are others."""
    labelled = budget.apply(data, command=TASK.command_columns)[0]
    data = data.clone()
    if inside:
        data["action"] = torch.where(labelled["has_action"], data["action"] * 1.5, data["action"])
        data["observation"] = torch.where(labelled["has_action"], data["observation"] * 1.5, data["observation"])
        return data
    data["action"] = torch.where(labelled["has_action"], data["action"], POISON)
    for key in ("observation", ("next", "observation")):
        kept = labelled["has_action"] if key == "observation" else torch.zeros_like(labelled["has_action"])
        data[key] = torch.where(labelled[key].isnan() & ~kept, POISON, data[key])
    return data


def weights(folder: Path) -> bytes:
    return (folder / "controller.safetensors").read_bytes()


# a trajectory that is labelled throughout tells its commands too
CASES = [(method, "window", False) for method in METHODS] + [("koap", "trajectory", False)]
CASES += [(method, "window", True) for method in ("koap", "dd", "dp", "vpt", "mpc")] + [("koap", "trajectory", True)]


@pytest.mark.parametrize(("method", "unit", "commands"), CASES)
def test_no_weight_of_any_method_depends_on_a_hidden_label(
    method, unit, commands, demonstrations, planner, tmp_path, monkeypatch
):
    task = replace(TASK, defaults=replace(TASK.defaults, commands=commands))
    monkeypatch.setattr(on_disk, "find_task_of", lambda *a: task)
    budget = LabelBudget(count=2, unit=unit, seed=0)
    real = open_dataset(demonstrations, task=TASK)[0]
    outside, inside = (poisoned(real, budget, inside=at) for at in (False, True))
    variants = {"clean": real, "outside": outside, "inside": inside}
    kept = budget.apply(real)[0]["has_action"].squeeze(-1)
    assert (variants["outside"]["action"][~kept] == POISON).all() and 0 < kept.sum() < len(kept)
    assert torch.equal(variants["outside"]["action"][kept], real["action"][kept])
    assert (variants["outside"]["observation"] > POISON / 2).any()
    for name, data in variants.items():
        monkeypatch.setattr(on_disk, "open_dataset", lambda *a, data=data, **o: (data.clone(), task))
        labels = LabelConfig(count=2, unit=unit)
        train_tiny(tmp_path / name, demonstrations, planner, method, labels=labels)
    assert weights(tmp_path / "outside") == weights(tmp_path / "clean")
    assert weights(tmp_path / "inside") != weights(tmp_path / "clean")  # else the test could not fail
    drawn = [(tmp_path / name / "demonstrations.safetensors").read_bytes() for name in ("clean", "outside")]
    assert drawn[0] == drawn[1] and not (tmp_path / "clean" / "actions.safetensors").exists()
    reports = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("clean", "outside")]
    assert settled(reports[0]) == settled(reports[1])


@pytest.mark.parametrize(("preset", "shaped"), [("default", False), ("scene", True)])
def test_labels_shape_the_latent_action_where_the_preset_says_so(
    preset, shaped, demonstrations, planner, tmp_path, monkeypatch
):
    real, found = open_dataset(demonstrations, task=TASK)[0], []
    for data in (real, poisoned(real, LabelBudget(count=2), inside=True)):
        monkeypatch.setattr(on_disk, "open_dataset", lambda *a, data=data, **o: (data.clone(), TASK))
        out = tmp_path / str(len(found))
        train_tiny(out, demonstrations, planner, "koap", controller=ControllerConfig(preset=preset, steps=4))
        tensors = load_tensors(out / "controller.safetensors")[0]
        found.append(torch.cat([each.flatten() for name, each in tensors.items() if name.startswith("latent_action.")]))
    assert torch.equal(*found) is not shaped


def test_no_weight_of_a_planner_depends_on_any_label(demonstrations, planner, tmp_path, monkeypatch):
    budget = LabelBudget(count=2)
    data = poisoned(poisoned(open_dataset(demonstrations, task=TASK)[0], budget), budget, inside=True)
    monkeypatch.setattr(on_disk, "open_dataset", lambda *a, **o: (data.clone(), TASK))
    train(TrainConfig(out=tmp_path / "run", dataset=str(demonstrations), method="linear", **TINY))
    name = "planner.safetensors"
    assert (tmp_path / "run" / name).read_bytes() == (planner / name).read_bytes()
    assert weights(tmp_path / "run") != weights(planner)


def settled(summary):
    summary.pop("train_seconds")
    for phase in ("planner", "controller"):
        summary[phase].pop("iterations_per_second", None)
    return summary


# killed and resumed


LONGER = {"planner": PlannerConfig(steps=12, batch_size=8, width=8), "controller": ControllerConfig(steps=12)}
MIDDLE, END = "in its middle", "at its end"
KILLED = {
    "koap": {"controller": (MIDDLE, END)},
    "pretrain": {"controller": (MIDDLE, END), "finetune": (MIDDLE,)},
    "vae": {"controller": (END,), "decoder": (MIDDLE,)},
    "lapo": {"controller": (END,), "decoder": (MIDDLE, END)},
    "nonlinear": {"controller": (MIDDLE,)},
    "dp": {"policy": (MIDDLE, END)},
    "relabel": {"teacher_controller": (MIDDLE, END), "controller": (MIDDLE,)},
    "vpt": {"teacher_controller": (END,), "policy": (MIDDLE,)},
}


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory, demonstrations, planner):
    """Runs that nobody interrupts, one per method, trained when first asked for."""
    folders = {}

    def get(method):
        if method not in folders:
            folders[method] = tmp_path_factory.mktemp("whole") / "run"
            train_tiny(folders[method], demonstrations, planner, method, **LONGER)
        return folders[method]

    return get


@pytest.mark.parametrize(
    ("method", "phase", "when"),
    [(method, phase, when) for method, phases in KILLED.items() for phase, times in phases.items() for when in times],
)
def test_a_method_killed_in_a_phase_or_behind_it_ends_bit_for_bit_like_one_that_was_not(
    method, phase, when, whole_run, demonstrations, planner, tmp_path, monkeypatch
):
    """In the middle: two updates behind the last checkpoint; at the end: the phase is saved, the next not begun."""
    save, saved = loop.save_training_state, []

    def killed(path, loss, optimizer, about):
        if about["phase"] == phase and when == MIDDLE and saved.count(phase) == 1:
            raise KeyboardInterrupt
        save(path, loss, optimizer, about)
        saved.append(about["phase"])
        if about["phase"] == phase and when == END and about["step"] == steps_of(whole_run(method), phase):
            raise KeyboardInterrupt

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        steps_of(whole_run(method), phase)  # trained before anything is killed
        patch.setattr(loop, "save_training_state", killed)
        patch.setattr(loop, "CHECKPOINT_EVERY", 2)
        with pytest.raises(KeyboardInterrupt):
            train_tiny(out, demonstrations, planner, method, **LONGER)
    assert not (out / "summary.json").exists()
    train(TrainConfig(out=out, run=RunConfig(resume=True)))
    assert weights(out) == weights(whole_run(method))
    mine, its = (settled(RunDirectory(folder).read_json("summary.json")) for folder in (out, whole_run(method)))
    assert mine == its
    rows = [RunDirectory(folder).read_metrics() for folder in (out, whole_run(method))]
    speed = "iterations_per_second"
    assert [{**row, speed: 0} for row in rows[0]] == [{**row, speed: 0} for row in rows[1]]


@pytest.mark.parametrize("method", [method for method in KILLED if METHODS[method].plans])
def test_phases_share_the_updates(method, whole_run):
    taken = [steps_of(whole_run(method), phase.name) for phase in METHODS[method].phases]
    assert sum(taken) == LONGER["controller"].steps and len(taken) == len(METHODS[method].phases)


def steps_of(run, phase):
    return load_tensors(run / "checkpoints" / f"{phase}.safetensors")[1]["step"]


def test_a_policy_without_plans_has_averaged_weights(whole_run):
    made = load_tensors(whole_run("dp") / "controller.safetensors")[0]
    saved = load_tensors(whole_run("dp") / "checkpoints" / "policy.safetensors")[0]
    name = "denoiser.first.weight" if "denoiser.first.weight" in made else "denoiser.head.3.weight"
    assert torch.equal(made[name], saved[f"loss.target_network_params.{name}"])
    assert not torch.equal(made[name], saved[f"loss.network_params.{name}"])


def test_a_share_of_the_trajectories_is_used_those_with_labels_first(demonstrations, planner, tmp_path):
    labels = LabelConfig(count=2, trajectories=0.5)
    found = train_tiny(tmp_path / "run", demonstrations, planner, "linear", labels=labels).results
    assert found["trajectories_used"] == 3  # of four, one was held out from the planner
    assert found["labels"]["trajectories_touched"] == 2
    drawn = load_tensors(tmp_path / "run" / "demonstrations.safetensors")[0]
    assert torch.equal(drawn["position"], drawn["state"])  # in Avoiding the state is the measured position


def test_a_planner_for_a_curve_knows_the_labelled_trajectories_and_holds_few_out(tmp_path, monkeypatch):
    states = [np.random.default_rng(index).normal(size=(40, 2)).cumsum(0) for index in range(40)]
    actions = [np.diff(frames, axis=0) if index > 36 else None for index, frames in enumerate(states)]
    data = save_demonstrations(tmp_path / "arm", states, actions, control_hz=30)
    seen, split = [], on_disk.split_held_out
    monkeypatch.setattr(on_disk, "split_held_out", lambda *given: seen.append(split(*given)) or seen[0])
    options = {"planner": replace(PLANNER, held_out=0.25), "labels": LabelConfig(trajectories=0.2)}
    found = train(TrainConfig(dataset=str(data), out=tmp_path / "run", **options), planner_only=True)
    known, unseen, _ = (part["episode"].unique().tolist() for part in seen[0])
    assert len(known) == 6 and {37, 38, 39} < set(known) and not seen[0][0]["has_action"].any()
    assert len(unseen) == 2 and tuple(unseen) == found.held_out


def test_what_a_shared_planner_has_not_seen_is_known_whatever_share_a_run_uses(tmp_path):
    states = [np.random.default_rng(index).normal(size=(40, 2)).cumsum(0) for index in range(10)]
    data = save_demonstrations(tmp_path / "arm", states, [np.diff(frames, axis=0) for frames in states], control_hz=30)
    few = {"dataset": str(data), "controller": ControllerConfig(steps=0), "method": "linear"}
    planner = train(
        TrainConfig(out=tmp_path / "planner", planner=PLANNER, run=RunConfig(seed=1), **few), planner_only=True
    )
    labels, source = LabelConfig(count=1, trajectories=0.3), PlannerConfig(source=tmp_path / "planner")
    run = train(TrainConfig(out=tmp_path / "run", labels=labels, planner=source, **few))
    assert len(planner.held_out) == 2 and run.held_out == planner.held_out


def test_a_planner_alone_is_no_policy_and_resumes_as_a_planner(demonstrations, tmp_path):
    out = tmp_path / "run"
    config = TrainConfig(out=out, dataset=str(demonstrations), planner=PLANNER)
    weights = train(config, planner_only=True).planner.state_dict()
    with pytest.raises(
        RunDirectoryError, match=r"run holds a planner for other runs \(planner.source\), not a policy$"
    ):
        Trained.load(out)
    again = TrainConfig(out=out, run=RunConfig(resume=True))
    with pytest.raises(RunDirectoryError, match=r"run holds a planner for other runs .*; choose another --out"):
        train(again)
    resumed = train(again, planner_only=True).planner.state_dict()
    assert all(torch.equal(value, resumed[name]) for name, value in weights.items())


def test_a_run_that_took_over_its_planner_resumes_without_the_source(demonstrations, tmp_path, monkeypatch):
    config = TrainConfig(out=tmp_path / "source", dataset=str(demonstrations), method="linear", **TINY)
    held_out = train(replace(config, planner=replace(PLANNER, held_out=0.25))).held_out
    config = replace(config, out=tmp_path / "run", planner=PlannerConfig(source=tmp_path / "source"))
    with monkeypatch.context() as patch:
        patch.setattr(on_disk, "learn_controller", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train(config)
    (tmp_path / "source").rename(tmp_path / "elsewhere")
    assert train(TrainConfig(out=tmp_path / "run", run=RunConfig(resume=True))).held_out == held_out
    assert len(held_out) == 2


def test_a_planner_is_shared_between_folders_of_the_same_columns(tmp_path):
    states = [np.random.default_rng(index).normal(size=(40, 3)).cumsum(0) for index in range(4)]
    actions = [np.diff(states[0][:, :2], axis=0), None, None, None]
    for name, hz in (("one", 30), ("two", 30), ("slow", 10)):
        save_demonstrations(tmp_path / name, states, actions, control_hz=hz)
    few = {"planner": PLANNER, "controller": ControllerConfig(steps=0)}
    own = train(TrainConfig(out=tmp_path / "run", dataset=str(tmp_path / "one"), **few))
    shared = {"planner": PlannerConfig(source=tmp_path / "run"), "controller": ControllerConfig(steps=0)}
    other = train(TrainConfig(out=tmp_path / "other", dataset=str(tmp_path / "two"), **shared))
    for ours, theirs in zip(own.planner.parameters(), other.planner.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    assert Trained.load(tmp_path / "other").task.name == "two"
    with pytest.raises(CheckpointError, match="was trained on task 'one', not on 'slow'"):
        train(TrainConfig(out=tmp_path / "wrong", dataset=str(tmp_path / "slow"), **shared))
    simulated = replace(other.task, env=TASK.env)
    with pytest.raises(CheckpointError, match="was trained on task 'one', not on 'two'"):
        on_disk.planner_of_source(simulated, other.config)
    save_demonstrations(tmp_path / "mm", states, actions, control_hz=30, name="one", state_units="mm")
    with pytest.raises(CheckpointError, match="with another state_units than the demonstrations"):
        train(TrainConfig(out=tmp_path / "wrong", dataset=str(tmp_path / "mm"), **shared))
    names = [f"state_{column}" for column in (1, 0, 2)]  # the same name, as `koap suggest` asks for, another order
    save_demonstrations(tmp_path / "next", states, actions, control_hz=10, name="one", state_names=names)
    with pytest.raises(CheckpointError, match="with another state_names and control_hz than the demonstrations"):
        train(TrainConfig(out=tmp_path / "wrong", dataset=str(tmp_path / "next"), **shared))
    assert not (tmp_path / "wrong").exists()


def test_a_training_leaves_the_caller_its_threads_and_random_numbers(tmp_path, demonstrations, planner):
    threads, state = torch.get_num_threads(), torch.manual_seed(11).get_state()
    train_tiny(tmp_path / "run", demonstrations, planner, "linear", run=RunConfig(threads=threads + 1))
    assert torch.get_num_threads() == threads and torch.equal(torch.get_rng_state(), state)


def test_the_start_of_a_logger_is_no_time_of_training(tmp_path, demonstrations, planner, monkeypatch):
    clock = Mock(perf_counter=Mock(return_value=0.0))

    @contextlib.contextmanager
    def start(*names):
        clock.perf_counter.return_value = 1e4  # s
        yield None

    monkeypatch.setattr(on_disk, "time", clock)
    monkeypatch.setattr(on_disk, "open_logger", start)
    train_tiny(tmp_path / "run", demonstrations, planner, "linear")
    summary = RunDirectory(tmp_path / "run").read_json("summary.json")
    assert summary["train_seconds"] == {"planner": 0.0, "controller": 0.0}


def test_fitting_has_the_threads_that_its_options_say(monkeypatch):
    told = []
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "set_num_threads", told.append)
    states = [np.random.default_rng(i).normal(size=(30, 4)).cumsum(0) for i in range(3)]
    data, task = make_demonstrations(states, [np.diff(s[:, :2], axis=0) for s in states], control_hz=30)
    trained = fit(data, task, method="linear", planner=False, progress=False)
    assert told[0] == trained.config.run.threads == 1
