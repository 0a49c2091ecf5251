# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the report: numbers, completeness, escaping, absent and damaged files."""

import json
from pathlib import Path

import numpy as np
import pytest
from html_pages import Page
from run_files import LABELS, make_demonstrations, make_object_rollouts, write_run
from safetensors.numpy import save_file
from small_networks import plain_task

from torchrl_koap.evaluation.statistics import expected_entropy
from torchrl_koap.reports import pictures
from torchrl_koap.reports.pictures import all_pictures, draw_pictures
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.tasks import get_task

PICTURES = list(all_pictures().values())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = write_run(tmp_path_factory.mktemp("run"))
    write_report(folder)
    return folder


def test_headline_has_intervals_and_n(run):
    text = Page(run / "index.html").text
    for wanted in (
        "50.0 % interval 95 % interval 15.0 to 85.0 %, 2 of 4 rollouts",
        f"0.22 2 of 24 modes; a uniform choice averages {expected_entropy(2, 24):.2f}, n = 2",
        "action error, 2 columns 0.91 mm root mean square; ridge on raw frames 1.04, always the mean action 3; 20",
        "time of a plan 8.5 ms then 0.5 ms per control step; the robot's step has 35 ms",
        "Outside the budget, for evaluation only: 20 labels",
    ):
        assert wanted in text


def test_order_headline_labels_pictures_commands(run):
    text = Page(run / "index.html").text
    places = [text.index(word) for word in ("Result", "Training", "Executed rollouts", "All numbers", "Do it again")]
    assert places == sorted(places)
    assert "koap train --out 'a folder'" in text
    solver = "--episodes 4 --seed 100 --strategy feedback --replan-interval 4"
    assert f"koap eval {run} {solver}" in text


def test_pictures_are_there_with_captions_and_no_outside_resource(run):
    page = Page(run / "index.html")
    # this run has kept no actions, was not inspected, and has an environment
    left_out = ("film.gif", "latent.png", "inspect.png", "plan_errors.png")
    expected = [picture for picture in PICTURES if picture.name not in left_out]
    assert {f"plots/{picture.name}" for picture in expected} <= set(page.links)
    for link in page.links:
        assert (run / link).is_file()
    for picture in expected:
        assert picture.title in page.text
    assert "http" not in page.source and page.tags.count("script") == 1 and "<script>" in page.source
    assert page.text.count("Not drawn") == 1 and f"Which part fails. Made by koap inspect {run} ." in page.text
    assert 'class="warning"' not in page.source


def test_no_key_is_dropped(tmp_path):
    write_run(tmp_path)
    for name in ("config", "summary", "eval"):
        path = tmp_path / f"{name}.json"
        content = json.loads(path.read_text())
        content[f"odd_{name}"] = {"deep": {"list": [{"a": 1.25}, {"b_mm": None}], "flag": True}, "text": f"only {name}"}
        path.write_text(json.dumps(content))
    page = Page(write_report(tmp_path, draw=False))
    for name in ("config", "summary", "eval"):
        assert f"odd {name} deep list a b (mm) 1.25 – – – flag yes text only {name}" in page.text
    assert "planner 32, 64" in page.text and "812,345" in page.text


def test_everything_from_files_is_escaped(tmp_path):
    evil = "<script>alert('1')</script>&\""
    content = {evil: evil, "command": evil, "task": evil, "method": evil, "seed": evil, "versions": {evil: evil}}
    (tmp_path / "config.json").write_text(json.dumps(content))
    summary = {"labels": LABELS | {evil: evil}, "train_seconds": {evil: 1.0}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    rate = {"rate": 0.5, "low": 0.4, "high": 0.6, "episodes": 10}
    evaluation = {"rates": {evil: rate}, "execution": {evil: evil}, "distinct_modes": evil, "mode_entropy": 0.1}
    evaluation["episodes"], evaluation["episode"] = 1, [{"seed": evil, evil: evil}]
    evaluation["action_errors"] = {"outside_budget": {"note": evil}}
    (tmp_path / "eval.json").write_text(json.dumps(evaluation))
    page = Page(write_report(tmp_path))
    assert page.tags.count("script") == 1 and page.source.count("<script") == 1
    assert "alert(" not in page.source.split("<script>")[1]
    assert page.source.count("&lt;script&gt;") > 12


def test_empty_run_says_which_commands_make_the_sections(tmp_path):
    folder = tmp_path / "my run"
    folder.mkdir()
    page = Page(write_report(folder))
    assert f"koap eval '{folder}' --episodes 60 --seed 100" in page.text
    assert f"koap train --out '{folder}'" in page.text
    assert "img" not in page.tags and not (folder / "plots").exists()


def test_commands_to_try_next_roll_out_in_the_environment_of_the_last_rollouts(tmp_path):
    rates = {"success": {"rate": 0.4, "low": 0.1, "high": 0.7, "episodes": 10}}
    evaluation = {"rates": rates, "env": "mine:Base-v0", "env_kwargs": ["name=my base"], "success_key": "is_success"}
    (tmp_path / "eval.json").write_text(json.dumps(evaluation))
    text, where = Page(write_report(tmp_path)).text, "--env mine:Base-v0 --env-kwargs 'name=my base' --success-key"
    assert f"koap eval {tmp_path} --out {tmp_path}_recorded" in text
    assert f"koap eval {tmp_path} --episodes 60 --seed 100 {where} is_success" in text


def test_a_run_without_a_simulator_is_evaluated_on_recordings(tmp_path):
    about = {"task": "plain", "task_definition": plain_task(2, 2).definition()}
    (tmp_path / "config.json").write_text(json.dumps(about))
    page = Page(write_report(tmp_path))
    assert f"koap eval {tmp_path}" in page.text and "--episodes" not in page.text
    (tmp_path / "eval.json").write_text(json.dumps({"trajectory": [{"name": "seventh", "labels": 3}]}))
    assert "seventh 3" in Page(write_report(tmp_path)).text


def test_a_picture_that_no_evaluation_could_leave_says_why(tmp_path):
    errors = {"outside_budget": {"note": "no labels outside the budget"}}
    (tmp_path / "eval.json").write_text(json.dumps({"action_errors": errors}))
    page = write_report(tmp_path).read_text()
    assert "Predicted against recorded actions: not drawn, no labels outside the budget." in page
    (tmp_path / "eval.json").write_text(json.dumps({"action_errors": {"outside_budget": {"relative": 0.1}}}))
    assert "Predicted against recorded actions: not drawn" not in write_report(tmp_path).read_text()


def test_a_training_without_updates_has_no_losses_to_draw(tmp_path):
    (write_run(tmp_path) / "metrics.csv").unlink()  # as with a given planner and a controller in closed form
    page = Page(write_report(tmp_path, draw=False))
    assert "Losses: not drawn, the training logged no loss." in page.text
    assert "Losses. Made by koap train" not in page.text


@pytest.mark.parametrize("name", ["config.json", "summary.json", "eval.json"])
@pytest.mark.parametrize("content", ['{"task": ', "[1, 2]", ""])
def test_damaged_json_is_named_and_the_rest_is_shown(name, content, tmp_path):
    write_run(tmp_path)
    (tmp_path / name).write_text(content)
    page = Page(write_report(tmp_path, draw=False))
    assert page.source.count('class="warning"') == 1 and str(tmp_path / name) in page.text
    assert ("50.0 % interval" in page.text) == (name != "eval.json")


@pytest.mark.parametrize("name", ["rollouts.safetensors", "actions.safetensors", "metrics.csv"])
def test_damaged_data_are_named_and_old_pictures_not_shown(name, tmp_path, monkeypatch):
    few = {p.name: p for p in PICTURES if p.source == name or p.name == "demonstrations.png"}
    monkeypatch.setattr(pictures, "_PICTURES", few)
    write_run(tmp_path)
    draw_pictures(tmp_path, animation=False)
    data = tmp_path / name
    data.write_bytes(data.read_bytes()[: -len(data.read_bytes()) // 2] if name != "metrics.csv" else b"phase,step\n")
    problems = draw_pictures(tmp_path, animation=False)
    wanted = {p.name for p in PICTURES if p.source == name and not p.name.endswith(".gif")}
    assert set(problems) == wanted and all(message.startswith(f"{name}: ") for message in problems.values())
    page = Page(write_report(tmp_path, animation=False))
    assert page.source.count('class="warning"') == len(wanted)
    assert not {f"plots/{picture}" for picture in wanted} & set(page.links)
    assert "plots/demonstrations.png" in page.links


def write_object_run(folder, task="stacking", **evaluation):
    """A run of a task with objects, with what an evaluation in contexts leaves."""
    write_run(folder)
    rollouts = make_object_rollouts(task)
    if not get_task(task).plans_position:
        rollouts |= {"plan": np.zeros((4, 0, 1, 2)), "plan_step": np.zeros((4, 0), int)}
    save_file(rollouts, folder / "rollouts.safetensors")
    demonstrations = {"position": np.random.rand(40, 2), "objects": np.random.rand(40, len(get_task(task).objects), 2)}
    data = make_demonstrations() | demonstrations
    save_file(data, folder / "demonstrations.safetensors")
    actions = np.random.rand(20, get_task(task).action_dim)
    save_file({"predicted": actions, "true": actions + 0.001}, folder / "actions.safetensors")
    for name, change in (("config", {"task": task}), ("eval", {"contexts": 2} | evaluation)):
        path = folder / f"{name}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | change))
    return folder


def test_tiles_of_a_task_with_contexts(tmp_path):
    rates = {"success": {"rate": 0.5, "low": 0.15, "high": 0.85, "episodes": 4}}
    rates["one box stacked"] = {"rate": 0.75, "low": 0.3, "high": 0.954, "episodes": 4}
    pooled = {"mode_entropy": None, "pooled_mode_entropy": 0.387, "pooled_mode_entropy_low": 0.0}
    write_object_run(tmp_path, rates=rates, **pooled, pooled_mode_entropy_high=0.5)
    text = Page(write_report(tmp_path, draw=False)).text
    even = f"a uniform choice averages {expected_entropy(2, 6):.2f}, n = 2"
    for wanted in (
        "50.0 % interval 95 % interval 15.0 to 85.0 %, 2 of 4 rollouts in 2 contexts",
        "one box stacked 75.0 % interval 95 % interval 30.0 to 95.4 %, 3 of 4 rollouts",
        f"mode entropy, all contexts together, base 6 0.39 95 % interval 0.00 to 0.50; 2 of 6 modes; {even}",
        "Outside the budget, for evaluation only: 20 labels",
    ):
        assert wanted in text
    assert "two boxes" not in text and "3 of 4 rollouts in" not in text


@pytest.mark.parametrize("task", ["aligning", "stacking"])
def test_report_of_a_task_with_objects(task, tmp_path, monkeypatch):
    """Every picture that the task has, no word of Avoiding, and one line where no film can be made."""
    monkeypatch.setenv("MUJOCO_GL", "off")
    (tmp_path / "plots").mkdir()
    (tmp_path / "plots" / "plans.png").write_bytes(b"of an earlier evaluation")
    page = Page(write_report(write_object_run(tmp_path, task)))
    plans = get_task(task).plans_position
    expected = (
        {picture.name for picture in PICTURES}
        - {"film.gif", "latent.png", "inspect.png", "plan_errors.png"}
        - (set() if plans else {"plans.png"})
    )
    assert {link.removeprefix("plots/") for link in page.links} == expected
    assert (tmp_path / "plots" / "plans.png").exists() is plans
    assert ("the rollouts hold no plans of positions" in page.text) is not plans
    assert page.source.count('class="warning"') == 1
    assert "film.gif was not made: rendering is switched off by the environment variable MUJOCO_GL=off" in page.text
    assert "cylinder" not in page.text and "gap taken" not in page.text
    assert "Squares are the objects" in page.text


def test_the_picture_of_rollouts_says_what_stands_in_the_scene():
    words = {"aligning": "thick far side", "sorting": "frames are the bins", "stacking": "still in the gripper"}
    for task, word in words.items():
        assert word in all_pictures()["rollouts.png"].caption_for(RunFacts(Path("run"), get_task(task)))


def test_no_such_directory(tmp_path):
    for function in (write_report, draw_pictures):
        with pytest.raises(FileNotFoundError, match="no run directory"):
            function(tmp_path / "none")
