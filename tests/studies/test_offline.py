# This source code is licensed under the MIT license found in the LICENSE file.
"""Curves of a task without an environment: action errors are what methods are compared by."""

from __future__ import annotations

import json
import math

import pytest
from offline_runs import save_arm

from torchrl_koap.studies.cells import Cell, cell_row, do_cell, do_planner
from torchrl_koap.studies.label_efficiency import CurveConfig, run_curve
from torchrl_koap.studies.paired_comparison import compare, compare_cells, read_errors
from torchrl_koap.studies.report import write_curve_report
from torchrl_koap.studies.summary import summarise
from torchrl_koap.studies.table import read_cells, write_cells

CELLS = [Cell(method, 1.0, 1.0, 0) for method in ("koap", "linear", "dp")]


@pytest.fixture(scope="module")
def curve(tmp_path_factory):
    """Three finished cells: one with a closed form, the ridge, and a policy without a planner."""
    root = tmp_path_factory.mktemp("curve")
    arm = save_arm(tmp_path_factory.mktemp("data") / "arm", joints=2)
    settings = {"dataset": str(arm), "steps": 20, "batch_size": 8, "denoiser_width": 8}
    do_planner(folder=str(root / CELLS[0].planner), observations=1.0, settings=settings)
    for cell in CELLS:
        planner = None if cell.planner is None else str(root / cell.planner)
        own = settings | {"controller_steps": 20}
        folder = str(root / cell.folder)
        evaluation = {"episodes": 60, "threads": 1, "samples": 2}
        do_cell(folder=folder, cell=vars(cell), planner=planner, settings=own, evaluation=evaluation)
    return root


@pytest.fixture(scope="module")
def rows(curve):
    return [cell_row(curve, cell, task="arm", label_unit="trajectory") for cell in CELLS]


def test_cells_hold_errors_and_no_success(curve, rows, tmp_path):
    koap, linear, dp = rows
    assert [row["status"] for row in rows] == ["done"] * 3 and {row["kind"] for row in rows} == {"offline"}
    assert "success_rate" not in koap and koap["relative_action_error"] > 0 and koap["action_error"] > 0
    assert koap["relative_plan_error"] == linear["relative_plan_error"] > 0  # they share the planner
    assert dp["relative_plan_error"] is dp["relative_action_error"] is None
    held_out = [json.loads((curve / cell.folder / "config.json").read_text()) for cell in CELLS]
    shared = json.loads((curve / CELLS[0].planner / "config.json").read_text())["validation_episodes"]
    assert [config.get("validation_episodes") for config in held_out] == [shared, shared, None]
    again = read_cells(write_cells(tmp_path / "cells.csv", rows))
    assert [row["relative_action_error"] for row in again] == [row["relative_action_error"] for row in rows]
    assert again[0]["episodes"] is again[0]["success_rate"] is None


def test_files_of_before_lack_the_new_columns(rows, tmp_path):
    path = write_cells(tmp_path / "cells.csv", [{**rows[0], "kind": None, "episodes": 2, "successes": 1}])
    lines = [line.split(",") for line in path.read_text().splitlines()]
    keep = [place for place, name in enumerate(lines[0]) if name not in ("kind", "relative_plan_error")]
    path.write_text("".join(",".join(line[place] for place in keep) + "\n" for line in lines))
    assert read_cells(path)[0]["relative_plan_error"] is None


def test_the_report_compares_by_action_errors(curve, rows):
    page = write_curve_report(curve, rows, title="Label efficiency on arm").read_text()
    assert "Errors on recorded data" in page and "koap errs less" in page and "succeeds more often" not in page
    assert "Wilson" not in page and (curve / "plots" / "arm_relative_action_error.png").exists()
    table = (curve / "table.md").read_text()
    assert "action error (of the mean action" in table and "success" not in table
    (linear, dp), problems = compare_cells(curve, rows)
    expected = summarise(rows)[0].relative_action_error - summarise(rows)[1].relative_action_error
    assert math.copysign(1, linear["difference"]) == math.copysign(1, expected) and linear["contexts"] == 3
    assert dp["difference"] is None and not problems


def test_errors_have_no_bounds_and_need_two_trajectories_for_an_interval():
    large = compare({0: {(1, 0): 5.0, (2, 0): 6.0}}, {0: {(1, 0): 1.0, (2, 0): 2.0}}, errors=True)
    assert (large.difference, large.low, large.high) == (4, 4, 4)
    assert math.isnan(compare({0: {(1, 0): 5.0}}, {0: {(1, 0): 1.0}}, errors=True).low)


def test_damaged_errors_are_named(tmp_path):
    path = tmp_path / "eval.json"
    path.write_text(json.dumps({"episode": []}))
    assert read_errors(path) is None
    path.write_text(json.dumps({"kind": "offline", "action_errors_on": "left_out", "action_errors": {}}))
    with pytest.raises(ValueError, match="eval.json: its action errors are damaged"):
        read_errors(path)


def test_a_curve_needs_data_where_it_has_no_environment(tmp_path, curve):
    from torchrl_koap.tasks import Action, Task, register_task
    from torchrl_koap.tasks.registry import TASKS

    register_task(Task(name="bare_arm", observation_parts={"q": 2}, actions={"dq": Action("rad")}, position="q"))
    try:
        with pytest.raises(ValueError, match="task 'bare_arm' has no environment to record demonstrations in"):
            run_curve(CurveConfig(out=tmp_path / "out", task="bare_arm"))
        from torchrl_koap.commands.data_commands import Demos

        with pytest.raises(ValueError, match="task 'bare_arm' has no environment: there is nothing to record"):
            Demos(out=tmp_path / "demos", task="bare_arm")()
    finally:
        del TASKS["bare_arm"]
    assert not list(tmp_path.iterdir())
