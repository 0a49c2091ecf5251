# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests runs of a robot without an environment, from data to a report."""

import json
import math
import re
import shutil

import numpy as np
import pytest
import torch
from offline_runs import record, save_arm, train_arm

from torchrl_koap import PlannerConfig
from torchrl_koap.commands.cli import main
from torchrl_koap.data import save_demonstrations
from torchrl_koap.evaluation import EvalConfig, InspectConfig, SuggestConfig, evaluate, inspect, suggest
from torchrl_koap.evaluation.data_errors import summarise_errors
from torchrl_koap.evaluation.findings import offline_faults
from torchrl_koap.evaluation.offline import evaluate_actions, evaluate_offline
from torchrl_koap.files import DataError
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.runs.config import LabelConfig
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import Action, Task
from torchrl_koap.training.trained import Trained

FEW = EvalConfig(threads=1)


@pytest.fixture(autouse=True)
def short_loops(monkeypatch):
    monkeypatch.setattr("torchrl_koap.evaluation.loop_on_labels.STEPS", 10)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    arm = save_arm(tmp_path_factory.mktemp("data") / "arm")
    return train_arm(tmp_path_factory.mktemp("runs") / "run", arm)


def test_a_run_of_seven_joints(run):
    result = evaluate(run, FEW)
    assert result == json.loads((run / "eval.json").read_text())
    assert result["kind"] == "offline" and "rates" not in result
    (group,) = result["plan_errors"]["unit"]
    assert group["unit"] == "rad" and len(group["columns"]) == 14 and len(group["planner"]["best_of"]["per_step"]) == 14
    assert result["action_errors"]["outside_budget"]["note"] == "no trajectory outside the budget has labels"
    left_out = result["action_errors"]["left_out"]
    assert left_out["trajectories"] == 3 and [row["name"] for row in left_out["column"]] == [f"dq{n}" for n in range(7)]
    assert result["action_errors_on"] == "left_out" and 0 < result["relative_action_error"] == left_out["relative"]
    held_out = json.loads((run / "config.json").read_text())["held_out_episodes"]
    assert [row["episode"] for row in result["trajectory"] if row["judged"] == "plans"] == held_out
    assert result["control_hz"] > 0 and not (run / "rollouts.safetensors").exists()
    # 20 updates make no planner, and it is said
    assert any(fault.startswith("plans are worse than standing still (columns in rad)") for fault in result["faults"])


def test_a_command_that_all_labels_repeat_has_no_error(tmp_path):
    states, steps = record(12, joints=2)
    steps = [None if each is None else np.c_[each[:, 0], np.full(len(each), 0.5)] for each in steps]
    kinds = {"action_kind": ["delta", "absolute"], "targets": [1]}  # distances from the state are decoded
    save_demonstrations(tmp_path / "arm", states, steps, control_hz=10, **kinds)
    run = train_arm(tmp_path / "run", tmp_path / "arm")
    moving, constant = evaluate(run, FEW)["action_errors"]["left_out"]["column"]
    assert constant["controller"] == 0 < moving["controller"]


@pytest.mark.parametrize("name", ["episodes", "rollouts_per_context", "batch_size"])
def test_options_of_rollouts_are_refused_where_there_are_none(run, name):
    with pytest.raises(ValueError, match=f"{name}: task 'arm' has no environment to roll out in: name one with --env"):
        evaluate(run, EvalConfig(threads=1, **{name: 4}))


def test_its_report_shows_pictures_and_speaks_of_no_rollouts(run):
    evaluate(run, FEW)
    page = write_report(run).read_text()
    pictures = {path.name for path in (run / "plots").iterdir()}
    assert {"plan_errors.png", "action_errors.png", "demonstrations.png", "losses.png"} <= pictures
    for word in ("plan error, 14 columns", "action error, 7 columns", "mrad", "plans are worse than standing still"):
        assert word in page
    for word in ("rollouts.png", "Executed rollouts", " mm", "x (m)", "--episodes 60", "koap inspect"):
        assert word not in page


def test_latent_space_and_suggestions(run):
    found = inspect(run, InspectConfig(latent_only=True, threads=1))["findings"]
    assert "mrad" in found and " mm" not in found
    assert "On labels of the budget, which the run's decoder was fitted on: a linear probe" in found
    assert {row["episode"] for row in suggest(run, SuggestConfig(count=7))["suggestions"]} == set(range(3, 10))
    with pytest.raises(
        ValueError, match="task 'arm' has no environment to make experiments in: name one with --env, or analyse"
    ):
        inspect(run)


def test_the_command_says_it_in_words(run, capsys):
    assert main(["eval", str(run), "--threads", "1", "--no-report"]) == 0
    out = capsys.readouterr().out
    rows = dict(re.split("  +", line, maxsplit=1) for line in out.splitlines())
    assert " mrad; energy score; standing still " in rows["plan error, 14 columns"]
    assert rows["action error, 7 columns"].endswith(" labels of recordings left out of the fit")
    assert rows["FAULT 1"].startswith("plans are worse than standing still") and "--steps" in rows["FAULT 1"]
    assert "steps on a linear model of the robot" in rows["largest command in a closed loop"]


def test_a_single_column_with_labels_outside_the_budget(tmp_path):
    arm = save_arm(tmp_path / "one", labelled=10, joints=1, units="")
    run = train_arm(tmp_path / "run", arm, labels=LabelConfig(count=2), method="linear")
    result = evaluate(run, FEW)
    outside = result["action_errors"]["outside_budget"]
    assert result["action_errors_on"] == "outside_budget" and outside["trajectories"] == 8
    # the method is that ridge itself
    assert outside["column"][0]["controller"] == pytest.approx(outside["column"][0]["ridge"], rel=1e-4)
    assert len(load_tensors(run / "actions.safetensors")[0]["true"]) == outside["labels"]
    labels = json.loads((run / "summary.json").read_text())["labels"]
    assert result["labels_read_outside_budget"] == labels["available_transitions"] - labels["labelled_transitions"] > 0
    page = write_report(run).read_text()
    assert "action_errors.png" in page and "None" not in page


def other_seed(run):
    """Returns errors of other plans, or other chunks of actions, sampled by another seed."""
    return evaluate_offline(Trained.load(run), EvalConfig(threads=1, seed=7))[0]


def test_columns_of_several_units_and_a_method_without_a_closed_form(tmp_path):
    arm = save_arm(tmp_path / "mixed", joints=3, units=["m", "rad", "N"])
    run = train_arm(tmp_path / "run", arm, method="dd")
    result = evaluate(run, FEW)
    assert [row["unit"] for row in result["plan_errors"]["unit"]] == ["m", "rad", "N"]
    assert "not fitted in closed form" in result["action_errors"]["left_out"]["note"]
    assert result["relative_action_error"] is None
    assert other_seed(run)["relative_plan_error"] != result["relative_plan_error"]
    write_report(run)
    assert (run / "plots" / "plan_errors.png").exists() and not (run / "plots" / "action_errors.png").exists()


def test_a_policy_of_its_own_is_judged_by_its_first_actions(tmp_path, capsys):
    arm = save_arm(tmp_path / "arm", labelled=6, joints=2)
    run = train_arm(tmp_path / "run", arm, method="dp", labels=LabelConfig(count=3), planner={"steps": 30})
    assert main(["eval", str(run), "--threads", "1"]) == 0
    assert re.search(r"action error, 2 columns .* labels outside the budget\n", capsys.readouterr().out)
    result = json.loads((run / "eval.json").read_text())
    outside = result["action_errors"]["outside_budget"]
    assert result["action_errors_on"] == "outside_budget" and outside["trajectories"] == 3
    assert result["labels_read_outside_budget"] >= outside["labels"] == 3 * 26
    assert result["relative_action_error"] == outside["relative"] > 0
    assert other_seed(run)["relative_action_error"] != outside["relative"]
    assert [row["columns"] for row in outside["unit"]] == [["dq0", "dq1"]]
    assert "trained again without each trajectory" in result["action_errors"]["left_out"]["note"]
    assert (run / "plots" / "action_errors.png").exists()


def test_a_single_trajectory(tmp_path):
    arm = save_arm(tmp_path / "arm", count=1, labelled=1, joints=2)
    run = train_arm(tmp_path / "run", arm, labels=LabelConfig(fraction=1.0), method="linear")
    result = evaluate(run, FEW)
    assert result["plan_errors"]["note"].startswith("no trajectory was held out from the planner")
    assert result["action_errors"]["left_out"]["note"] == "only one trajectory has labels: none can be left out"
    assert result["relative_plan_error"] is result["relative_action_error"] is None and result["faults"] == []
    write_report(run)


def test_rollouts_do_not_need_the_data_of_the_training(copied_run, tmp_path):
    """Nothing is left in its folder, or other recordings are there now; ``dataset`` must name the right ones."""
    content = json.loads((copied_run / "config.json").read_text())
    other = save_arm(tmp_path / "other")
    (tmp_path / "empty").mkdir()
    for folder, says, error in ((tmp_path / "empty", "no data set", FileNotFoundError), (other, "it holds", DataError)):
        (copied_run / "config.json").write_text(json.dumps(content | {"dataset": str(folder)}))
        trained = Trained.load(copied_run)
        found, actions, data = evaluate_actions(trained)
        assert says in found["action_errors"]["outside_budget"]["note"] and not actions and data is None
        with pytest.raises(error, match=says):
            evaluate_actions(trained, str(folder))


def test_a_data_set_that_has_moved_or_changed(tmp_path):
    arm = save_arm(tmp_path / "arm", joints=2)
    run = train_arm(tmp_path / "run", arm, method="linear")
    arm.rename(tmp_path / "elsewhere")
    with pytest.raises(RunDirectoryError, match=r"arm' of .*run is not there \(moved.*--dataset"):
        evaluate(run, FEW)
    moved = EvalConfig(threads=1, dataset=str(tmp_path / "elsewhere"))
    assert evaluate(run, moved)["plan_errors"]["trajectories"] == 2
    save_arm(tmp_path / "others", joints=2, count=4)
    taken = PlannerConfig(source=run)
    again = train_arm(tmp_path / "again", tmp_path / "others", method="linear", planner=taken)
    assert evaluate(again, FEW)["plan_errors"]["note"].endswith("held out from its planner are not in this data set")
    shutil.rmtree(tmp_path / "elsewhere")
    save_arm(tmp_path / "elsewhere", joints=2, labelled=4)
    with pytest.raises(RunDirectoryError, match="is not the one that .* trajectories or labels differ"):
        evaluate(run, moved)


def test_a_controller_worse_than_the_mean_is_a_fault():
    task = Task(name="arm", observation_parts={"q": 2}, actions={"a": Action("rad"), "b": Action("rad")}, position="q")
    true = torch.tensor([[1.0, 1.0], [-1.0, -1.0]])
    models = {"controller": true * torch.tensor([0.5, -1.0]), "ridge": true, "mean_action": torch.zeros(2, 2)}
    found = summarise_errors(models, true, torch.tensor([4, 5]), task)
    assert found["relative"] == pytest.approx(math.sqrt((0.25 + 4) / 2))
    assert [row["episode"] for row in found["trajectory"]] == [4, 5]
    faults = offline_faults({"note": ""}, {"left_out": found, "outside_budget": {"note": ""}})
    assert faults == [
        "action b is worse than always giving its mean (each labelled recording left out in turn): 2000 against 1000"
        " mrad; fix what `koap validate` warns about, check --action-kind and --robot, or label a recording that"
        " moves it"
    ]
    models["controller"] = true * torch.tensor([0.2, 0.05])  # well in the other column, which outweighs it
    (fault,) = offline_faults({}, {"left_out": summarise_errors(models, true, torch.tensor([4, 5]), task)})
    assert fault.startswith("action b is hardly better than always giving its mean") and "950 against 1000" in fault


def test_a_switch_that_rounding_seldom_gives_is_a_fault_and_has_no_share_in_errors_of_others():
    task = Task(
        name="arm", observation_parts={"q": 1}, actions={"a": Action(), "brake": Action(kind="raw")}, position="q"
    )
    true = torch.tensor([[0.1, 0.0], [-0.1, 0.0], [0.1, 1.0], [-0.1, 1.0], [0.0, 1.0]])
    answers = {"controller": torch.tensor([0.5, 0.6]), "ridge": 1.0, "mean_action": torch.tensor([0.0, 0.6])}
    models = {name: true * share for name, share in answers.items()}
    models["controller"][2:4, 1] = 0.4
    found = summarise_errors(models, true, torch.tensor([4, 4, 4, 5, 5]), task)
    assert [row["columns"] for row in found["unit"]] == [["a"], ["brake"]]
    fault = offline_faults({}, {"left_out": found})[-1]
    assert fault.startswith("action brake is predicted nearest to 1 in only 1 of 3 labels of that value (each labelled")


def test_a_recording_whose_labels_disagree_is_named(tmp_path):
    for name, sign in (("good", 1), ("bad", -1)):  # in one file
        (tmp_path / name).mkdir()
        for index, (frames, steps) in enumerate(zip(*record(12, joints=2), strict=True)):
            labelled = index in (0, 1, 2, 5, 10)
            table = np.c_[frames, steps * (sign if index == 2 else 1)] if labelled else frames
            header = ",".join(["x", "y", "goal_x", "goal_y", *(("action_0", "action_1") if labelled else ())])
            np.savetxt(tmp_path / name / f"run_{index}.csv", table, delimiter=",", header=header, comments="")
        call = ("convert", tmp_path / name, "--out", tmp_path / f"{name}_data", "--control-hz", "10", "--quiet")
        assert main([*map(str, call)]) == 0
        run = train_arm(tmp_path / f"{name}_run", tmp_path / f"{name}_data", method="linear_steps")
        odd = [fault for fault in evaluate(run, FEW)["faults"] if "disagree" in fault]
        assert len(odd) == (name == "bad")
    assert odd[0].startswith("labels disagree with those of other recordings (each left out in turn")
    assert re.search(r"median of the others [\d.]+\): run_2\.csv \([\d.]+\)[^;]*; check the sign, order", odd[0])
