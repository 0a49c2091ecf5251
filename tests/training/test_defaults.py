# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the order of defaults: given > method > task > network > library."""

from dataclasses import fields, replace

import numpy as np
import pytest

from torchrl_koap import ControllerConfig, Execution, ExecutionConfig, LabelConfig, PlannerConfig, TrainConfig
from torchrl_koap.data import make_demonstrations
from torchrl_koap.runs.config_files import to_json
from torchrl_koap.runs.device import DTYPES
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.training import METHODS
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_controller


def resolved(task="avoiding", method=None, **sections):
    return resolve(TrainConfig(out="run", method=method, **sections), get_task(task))


@pytest.mark.parametrize("task", TASKS)
def test_nothing_is_left_open_and_a_second_pass_changes_nothing(task):
    for method in METHODS:
        config = resolved(task, method)
        for section in (config.planner, config.controller, config.execution):
            missing = {field.name for field in fields(section) if getattr(section, field.name) is None}
            assert missing <= {"source"}, method
        assert config.labels.fraction == 1.0 and config.task == task and config.run.precision in DTYPES
        assert resolve(config, get_task(task)) == config


def test_the_tasks_method_is_trained_unless_another_is_asked_for():
    assert {resolved(task).method for task in TASKS} == {"koap"} and resolved("stacking", "linear").method == "linear"
    task = get_task("stacking")
    own = replace(task, defaults=replace(task.defaults, method="mpc"))
    assert resolve(TrainConfig(out="run"), own).method == "mpc"


class TestTheTasksPreset:
    def test_is_that_of_its_own_method_unless_another_is_asked_for(self):
        assert resolved("po_sorting").controller.preset == "semi_supervised"
        assert resolved("po_sorting", controller=ControllerConfig(preset="default")).controller.preset == "default"
        assert resolved("sorting").controller.preset == "default"

    @pytest.mark.parametrize(
        ("method", "own"), [("koap_untrained", "default"), ("koap_paper", "paper"), ("pca", "default")]
    )
    def test_is_not_that_of_other_methods(self, method, own):
        assert resolved("po_sorting", method).controller.preset == own

    @pytest.mark.parametrize("method", ["koap", "linear_steps", "dd", "koap_untrained"])
    def test_looks_further_ahead_where_actions_are_targets(self, method):
        states = [np.random.default_rng(0).normal(size=(20, 2)).cumsum(0)]
        kinds = {"absolute": ("delayed", 7), "delta": ("default", 10)}
        for kind, (preset, most) in kinds.items():
            actions = [states[0][1:] if kind == "absolute" else np.diff(states[0], axis=0)]
            targets = [0, 1] if kind == "absolute" else None
            _, own = make_demonstrations(states, actions, control_hz=100, action_kind=kind, targets=targets)
            config = resolve(TrainConfig(out="run", method=method), own)
            assert config.controller.preset == preset
            # what the last action of a plan reads is in the plan
            assert config.execution.replan_interval == (4 if method == "dd" else most)

    @pytest.mark.parametrize("method", ["koap", "linear_steps", "dd", "koap_untrained"])
    def test_is_absolute_for_every_method_that_decodes_commands(self, method):
        assert resolved("stacking", method).controller.preset == "absolute"
        hidden = resolved("stacking_unobserved_joints", method).controller
        assert hidden.preset == ("scene" if method == "koap" else "absolute") and hidden.columns == "related"
        asked = resolved("stacking", method, controller=ControllerConfig(preset="default")).controller
        assert asked.preset == "default" and resolved("stacking", "mpc").controller.preset == "default"

    def test_must_be_one_of_the_methods(self):
        with pytest.raises(ValueError, match="method 'pca' has no preset 'paper', it has"):
            resolved(method="pca", controller=ControllerConfig(preset="paper"))
        with pytest.raises(ValueError, match="unknown preset 'papper'; did you mean 'paper'"):
            resolved(controller=ControllerConfig(preset="papper"))


class TestThePlanner:
    def test_is_the_tasks_unless_a_network_is_named(self):
        aligning, named = (
            resolved("aligning", planner=PlannerConfig(network=network)).planner for network in (None, "unet")
        )
        found = [(each.network, each.width, each.batch_size, each.learning_rate) for each in (aligning, named)]
        assert found == [("mlp", 512, 512, 1e-3), ("unet", 64, 128, 3e-3)]
        assert named.steps == aligning.steps == 16000 and named.frames == aligning.frames == 1
        assert resolved(planner=PlannerConfig(network="mlp")).planner.width == 512
        assert resolved("stacking", planner=PlannerConfig(width=64)).planner.width == 64
        assert resolved().planner.width == 32
        bare = replace(get_task("avoiding"), defaults=replace(get_task("avoiding").defaults, planner={}))
        assert resolve(TrainConfig(out="run"), bare).planner.steps == 12000

    def test_lends_its_network_but_not_its_frames_to_methods_that_sample_actions(self):
        actions, plans = (resolved("sorting", method).planner for method in ("dp", "koap"))
        assert (plans.frames, plans.network, plans.batch_size) == (1, "objects", 256)
        assert actions == replace(plans, frames=2, held_out=0.0)
        for name, value in {"source": "run", "held_out": 0.5, "frames": 1}.items():
            with pytest.raises(ValueError, match=f"planner.{name}: method 'dp' samples actions and has no planner"):
                resolved(method="dp", planner=PlannerConfig(**{name: value}))

    def test_is_kept_from_a_tenth_of_the_data_and_smaller_where_there_is_no_environment(self):
        _, task = make_demonstrations([[[0.0, 0.0]] * 20], control_hz=30, action_dim=2)
        config = resolve(TrainConfig(out="run"), task)
        assert config.planner.held_out == resolved().planner.held_out == 0.1
        assert (config.planner.network, config.planner.width, config.planner.octaves) == ("mlp", 512, 0)
        unet = resolve(TrainConfig(out="run", planner=PlannerConfig(network="unet")), task).planner
        assert (unet.network, unet.width, unet.octaves, unet.steps) == ("unet", 64, 4, 3000)
        wide = replace(task, defaults=replace(task.defaults, planner={"network": "unet", "width": 32}))
        wide = resolve(TrainConfig(out="run"), wide).planner
        assert (wide.network, wide.width, wide.batch_size, wide.held_out) == ("unet", 32, 128, 0.1)

    def test_that_is_taken_over_is_as_it_was_trained(self, tmp_path):
        theirs = resolved(planner=PlannerConfig(steps=7, width=8))
        RunDirectory(tmp_path).write_json("config.json", to_json(theirs))
        mine = resolved(planner=PlannerConfig(source=tmp_path)).planner
        assert mine == replace(theirs.planner, source=tmp_path)
        for name, asked in (("width", 64), ("steps", 9)):
            with pytest.raises(ValueError, match=f"planner.{name} {asked} was asked for, but that of .* is"):
                resolved(planner=PlannerConfig(source=tmp_path, **{name: asked}))


class TestExecution:
    @pytest.mark.parametrize(("rate", "steps"), [(5, 4), (30, 4), (50, 5), (80, 8), (100, 10), (1000, 10)])
    def test_with_feedback_follows_a_plan_for_a_tenth_of_a_second(self, rate, steps):
        task = replace(get_task("avoiding"), control_hz=rate)
        for method in ("koap", "lapo", "dp", "dd"):
            found = resolve(TrainConfig(out="run", method=method), task).execution
            assert found.replan_interval == (steps if found.strategy == "feedback" else 4), method
        pca = resolve(TrainConfig(out="run", method="pca"), task)
        assert pca.execution.replan_interval == min(steps, 7)  # it reads eight frames ahead
        assert build_controller(task, get_method("pca"), pca.controller).reader.look_ahead[-1] == 8

    def test_of_a_method_goes_before_the_tasks(self):
        def execution(*names, **asked):
            return resolved(*names, execution=ExecutionConfig(**asked)).execution.on(Execution())

        assert execution() == Execution(candidates=4)
        assert execution("scooping") == Execution("open_loop", replan_interval=8, blend=0.0)
        assert execution("scooping", strategy="feedback") == Execution(replan_interval=8, blend=0.0)
        assert execution("avoiding", "koap_paper") == Execution("open_loop", blend=0.0)
        assert execution("avoiding", "koap_paper", blend=0.5).blend == 0.5
        assert execution("po_sorting").gain > 1 and execution("po_sorting", "mpc").gain == 1
        assert execution("avoiding", "dp") == Execution("open_loop", candidates=4)
        assert (execution("sorting").temperature, execution("sorting", "dp").temperature) == (0.5, 1.0)
        steps = {method: execution("stacking", method).replan_interval for method in ("koap", "dd", "dp")}
        assert steps == {"koap": 8, "dd": 8, "dp": 4}

    def test_of_ones_own_data_follows_plans_near_their_mean(self):
        _, task = make_demonstrations([[[0.0, 0.0]] * 20], control_hz=30, action_dim=2)

        def execution(task, method="koap", **asked):
            config = TrainConfig(out="run", method=method, execution=ExecutionConfig(**asked))
            return resolve(config, task).execution.on(Execution())

        assert execution(task) == Execution(temperature=0.4) and execution(task, "dp").temperature == 0.4
        assert execution(get_task("aligning")) == Execution(lead=0.1)
        fast = replace(task, control_hz=100)
        assert execution(fast).replan_interval == 10 and execution(fast, replan_interval=3).replan_interval == 3
        assert execution(task, temperature=0.2).temperature == 0.2 and execution(task, "koap_paper").temperature == 1.0
        own = replace(task, defaults=replace(task.defaults, execution={"temperature": 0.9}))
        assert execution(own).temperature == 0.9

    def test_of_plans_is_refused_where_there_are_none(self):
        with pytest.raises(ValueError, match="strategy 'feedback' was asked of method 'dp', which samples"):
            resolved(method="dp", execution=ExecutionConfig(strategy="feedback"))
        with pytest.raises(ValueError, match=r"blend 0\.2 was asked of method 'dp', which samples actions"):
            resolved(method="dp", execution=ExecutionConfig(blend=0.2))
        with pytest.raises(ValueError, match="'oracle' reads a simulation: it is for `koap eval`"):
            resolved(execution=ExecutionConfig(strategy="oracle"))


def test_a_method_declares_columns_and_labels_stay_as_asked():
    assert resolved("sorting", "koap_paper").controller.columns == "all"
    assert resolved("sorting").controller.columns == "robot" and resolved("sorting").controller.steps == 500
    closed = ("linear", "linear_steps", "pca", "koap_untrained")
    none = "config.json names no updates then"
    assert {resolved(method=method).controller.steps for method in (*closed, "dp")} == {0}, none
    asked = ControllerConfig(steps=7)
    assert {resolved(method=method, controller=asked).controller.steps for method in (*closed, "dp")} == {0}, none
    assert resolved(labels=LabelConfig(count=3)).labels == LabelConfig(count=3)


def test_no_updates_are_refused_where_no_closed_form_would_fit_the_network():
    for method in ("dd", "koap_paper", "pretrain", "vpt"):
        with pytest.raises(ValueError, match=f"controller.steps 0: method '{method}' has no closed form"):
            resolved(method=method, controller=ControllerConfig(steps=0))
    for method in ("koap", "linear", "mpc", "dp"):
        assert resolved(method=method, controller=ControllerConfig(steps=0)).controller.steps == 0
