# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests planners and cells of a study: no labels in planners; unreadable results are made again or named."""

import math
import shutil
from dataclasses import replace

import pytest
from offline_runs import save_arm

from torchrl_koap import ControllerConfig, EvalConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies import cells as cells_file
from torchrl_koap.studies.cells import Cell, cell_row, prepare_cell, read_result, run_cell
from torchrl_koap.studies.paired_comparison import compare, compare_cells
from torchrl_koap.studies.report import write_study_report
from torchrl_koap.studies.table import CELL_COLUMNS, summarise

CELL = Cell("avoiding", "linear", 0.25, 1.0, 0)
ROW = {"label_unit": "trajectory"}
FEW = {"planner": PlannerConfig(steps=3, network="unet", width=8), "controller": ControllerConfig(steps=3)}


def planner_config(out, demonstrations):
    return TrainConfig(out=out, dataset=str(demonstrations), planner=FEW["planner"])


def make(folder, config, evaluation=None):
    prepare_cell(folder, config, evaluation)
    run_cell(folder)
    return folder


def cell_config(root, planner, demonstrations, **options):
    known = {"labels": LabelConfig(fraction=0.25), "planner": PlannerConfig(source=planner)}
    known |= {"method": "linear", "controller": FEW["controller"]}
    return TrainConfig(out=root / CELL.folder, dataset=str(demonstrations), **known | options)


@pytest.fixture(scope="module")
def planner(tmp_path_factory, demonstrations):
    folder = tmp_path_factory.mktemp("study") / "planner"
    return make(folder, planner_config(folder, demonstrations))


@pytest.fixture(scope="module")
def finished(planner, demonstrations):
    root = planner.parent
    make(root / CELL.folder, cell_config(root, planner, demonstrations), EvalConfig(episodes=1, threads=1))
    return root


@pytest.fixture
def root(finished, tmp_path):
    shutil.copytree(finished / "cells", tmp_path / "cells")
    return tmp_path


def test_cells_have_folders_of_their_own():
    shares = (0.01, 0.25, 1.0, 1 / 3, 0.3333333, 1e-5, 1e-7)
    cells = [Cell(task, method, share, 1.0, 0) for task in "ab" for method in ("koap", "dp") for share in shares]
    assert len({cell.folder for cell in cells}) == len(cells)
    assert Cell("avoiding", "koap", 0.01, 1.0, 2).folder == "cells/avoiding/koap-0.01-1-seed2"


def test_a_row_says_what_a_cell_found(finished):
    row, outcomes = cell_row(finished, CELL, **ROW)
    run = RunDirectory(finished / CELL.folder)
    result, summary = run.read_json("eval.json"), run.read_json("summary.json")
    assert row["status"] == "done" and set(row) <= set(CELL_COLUMNS)
    assert (row["method"], row["labels"], row["demonstrations"], row["seed"]) == ("linear", 0.25, 1.0, 0)
    assert row["episodes"] == len(result["episode"]) == len(outcomes) == 1
    assert row["successes"] == sum(outcomes.values())
    assert row["mean_steps"] == result["episode"][0]["steps"]
    assert row["train_seconds"] == sum(summary["train_seconds"].values())
    assert row["labelled_units"] == row["trajectories_touched"] == 2
    assert row["labelled_transitions"] == summary["labels"]["labelled_transitions"] > 0
    assert row["action_error"] == 1e3 * result["action_errors"]["outside_budget"]["unit"][0][
        "controller"
    ] and math.isfinite(row["action_error"])
    assert row["action_error_unit"] == "mm"


def test_a_cell_that_is_not_done_is_missing_or_failed(tmp_path):
    assert read_result(tmp_path / CELL.folder) is None
    assert cell_row(tmp_path, CELL, **ROW)[0]["status"] == "missing"
    row, outcomes = cell_row(tmp_path, CELL, **ROW, reason="no memory")
    assert (row["status"], row["reason"], outcomes) == ("failed", "no memory", {})


DAMAGES = {
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:20]),
    "empty": lambda file: file.write_bytes(b""),
    "a list": lambda file: file.write_text("[1, 2]"),
    "binary": lambda file: file.write_bytes(b"\xff\xfe\x00" * 30),
    "without a row": lambda file: file.write_text('{"outcomes": []}'),
    "a number as row": lambda file: file.write_text('{"row": 5, "outcomes": []}'),
    "a number as outcomes": lambda file: file.write_text('{"row": {}, "outcomes": 7}'),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_result_that_cannot_be_read_is_named_and_not_done(damage, root):
    DAMAGES[damage](root / CELL.folder / "result.json")
    row, _ = cell_row(root, CELL, **ROW)
    assert row["status"] == "failed" and CELL.folder in row["reason"]
    assert cell_row(root, CELL, **ROW, reason="tried again")[0]["reason"] == "tried again"


def test_a_damaged_cell_is_made_again_without_being_trained_again(finished):
    folder = finished / CELL.folder
    before = read_result(folder)
    weights = (folder / "controller.safetensors").stat().st_mtime_ns
    (folder / "result.json").write_text("{")
    run_cell(folder)
    (after, outcomes), clock = read_result(folder), ("train_seconds", "eval_seconds")
    assert outcomes == before[1]
    assert {k: v for k, v in after.items() if k not in clock} == {k: v for k, v in before[0].items() if k not in clock}
    assert (folder / "controller.safetensors").stat().st_mtime_ns == weights


def test_a_cell_that_was_killed_while_it_was_trained_goes_on(finished):
    folder = finished / CELL.folder
    before = read_result(folder)[1]
    for name in ("controller.safetensors", "summary.json", "eval.json", "result.json"):
        (folder / name).unlink()
    run_cell(folder)
    assert read_result(folder)[1] == before


def test_a_cell_is_evaluated_on_the_data_where_they_are_now(root, planner, tmp_path, monkeypatch):
    folder, asked = root / CELL.folder, []
    config = replace(cell_config(root, planner, tmp_path / "moved"), out=planner.parent / CELL.folder)
    prepare_cell(folder, config, EvalConfig(episodes=1, threads=1))
    (folder / "result.json").unlink()
    found = RunDirectory(folder).read_json("eval.json")
    monkeypatch.setattr(cells_file, "evaluate", lambda run, evaluation: asked.append(evaluation.dataset) or found)
    run_cell(folder)
    assert asked == [str(tmp_path / "moved")] and read_result(folder) is not None


def test_outcomes_are_compared_by_context_and_else_by_seed():
    rows = [{"seed": 100, "outcome": "success", "context": 7}, {"seed": 101, "outcome": "timeout"}]
    rows += [{"seed": 102, "outcome": "collision", "context": 0}]
    assert cells_file._outcomes_of({"episode": rows}) == [[7, 100, True], [101, 101, False], [0, 102, False]]


def test_successes_are_whole_and_the_entropy_is_pooled_where_contexts_have_one_rollout_each():
    counts = {"selected_units": 1, "labelled_transitions": 9, "trajectories_touched": 1}
    success = {"rate": 29 / 50, "low": 0.4, "high": 0.7}  # 28.999999999999996 of 50
    found = {"action_errors_on": None, "rates": {"success": success}, "episodes": 50}
    found |= {"mode_entropy": None, "pooled_mode_entropy": 0.25}
    for result, entropy in ((found, 0.25), (found | {"mode_entropy": 0.0}, 0.0)):
        row = cells_file._found_in({"labels": counts, "controller_updates": 0}, result)
        assert (row["successes"], row["mode_entropy"]) == (29, entropy)
        assert [row[f"success_{name}"] for name in success] == [*success.values()]


def test_a_trajectory_without_a_relative_error_has_no_outcome():
    """Where no recorded action varies, no error is relative to that of the mean action."""
    rows = [{"episode": 3, "relative_action_error": None}]
    found = {"kind": "offline", "action_errors_on": "left_out", "action_errors": {"left_out": {"trajectory": rows}}}
    assert cells_file._outcomes_of(found) == []


def test_a_cell_of_which_something_else_was_asked_is_refused(root, planner, demonstrations):
    config = replace(cell_config(root, planner, demonstrations), out=planner.parent / CELL.folder)
    folder, evaluation = root / CELL.folder, EvalConfig(episodes=1, threads=1)
    prepare_cell(folder, replace(config, run=RunConfig(plugins=("json",))), evaluation)  # plugins may grow
    with pytest.raises(RunDirectoryError, match="was started with another controller.steps"):
        prepare_cell(folder, replace(config, controller=ControllerConfig(steps=7)), evaluation)


@pytest.mark.parametrize("content", ["{", "[]", '{"train": {}}', '{"train": 5, "evaluation": null}'])
def test_a_damaged_request_is_named_and_written_again(content, tmp_path):
    config, evaluation = planner_config(tmp_path, tmp_path), EvalConfig(episodes=1)
    (tmp_path / "cell.json").write_text(content)
    with pytest.raises(RunDirectoryError, match="cell.json"):
        cells_file.read_asked(tmp_path)
    prepare_cell(tmp_path, config, evaluation)
    assert cells_file.read_asked(tmp_path) == (config, evaluation)


OFFLINE = [Cell("arm", method, 1.0, 1.0, 0) for method in ("koap", "linear", "dp")]


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Three cells without an environment: one with a closed form, the ridge, and a policy without a planner."""
    root = tmp_path_factory.mktemp("study")
    dataset = str(save_arm(tmp_path_factory.mktemp("data") / "arm", joints=2))
    few = PlannerConfig(steps=20, batch_size=8, network="unet", width=8)
    make(root / "planner", TrainConfig(out=root / "planner", dataset=dataset, planner=few))
    for cell in OFFLINE:
        planner = few if cell.method == "dp" else PlannerConfig(source=root / "planner")
        known = {"method": cell.method, "planner": planner, "controller": ControllerConfig(steps=20)}
        config = TrainConfig(out=root / cell.folder, dataset=dataset, labels=LabelConfig(fraction=1.0), **known)
        make(root / cell.folder, config, EvalConfig(threads=1))
    return root, [cell_row(root, cell, **ROW) for cell in OFFLINE]


def test_cells_without_an_environment_hold_errors_and_no_success(arm):
    root, found = arm
    koap, linear, dp = rows = [row for row, _ in found]
    assert [row["status"] for row in rows] == ["done"] * 3 and {row["kind"] for row in rows} == {"offline"}
    assert "success_rate" not in koap and koap["relative_action_error"] > 0 and koap["action_error"] > 0
    assert koap["action_error_unit"] == "mrad"
    assert koap["relative_plan_error"] == linear["relative_plan_error"] > 0  # they share the planner
    assert dp["relative_plan_error"] is dp["relative_action_error"] is None
    held_out = [RunDirectory(root / cell.folder).read_json("config.json").get("held_out_episodes") for cell in OFFLINE]
    shared = RunDirectory(root / "planner").read_json("config.json")["held_out_episodes"]
    assert held_out == [shared, shared, None]


def test_the_report_compares_by_action_errors(arm):
    root, found = arm
    rows, outcomes = [row for row, _ in found], {row["run"]: own for row, own in found}
    page = write_study_report(root, rows, outcomes, title="Label efficiency on arm").read_text()
    assert "Errors on recorded data" in page and "koap errs less" in page and "succeeds more often" not in page
    assert "Wilson" not in page and (root / "plots" / "arm_relative_action_error.png").exists()
    table = (root / "table.md").read_text()
    assert "action error (of the mean action" in table and "success" not in table
    linear, dp = compare_cells(rows, outcomes)
    koap, other = (item.mean("relative_action_error") for item in summarise(rows)[:2])
    assert math.copysign(1, linear["difference"]) == math.copysign(1, koap - other) and linear["contexts"] == 3
    assert dp["difference"] is None


def test_errors_have_no_bounds_and_need_two_trajectories_for_an_interval():
    large = compare({0: {(1, 0): 5.0, (2, 0): 6.0}}, {0: {(1, 0): 1.0, (2, 0): 2.0}}, errors=True)
    assert (large.difference, large.low, large.high) == (4, 4, 4)
    assert math.isnan(compare({0: {(1, 0): 5.0}}, {0: {(1, 0): 1.0}}, errors=True).low)
