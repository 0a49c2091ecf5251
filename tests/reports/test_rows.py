# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the summary of a training: labels read, training of each part, reason of its end."""

import pytest
from run_files import LABELS, run_of

from torchrl_koap.reports.rows import Row, as_text, evaluation_rows, training_rows

CONFIG = {"method": "koap", "planner": {"steps": 500, "frames": 1, "source": None}}
PLANNER = {"updates": 500, "kept_update": 500, "best_held_out_score": 0.263}
SUMMARY = {
    "labels": LABELS,
    "planner_parameters": 9,
    "planner": PLANNER,
    "train_seconds": {"planner": 21.7, "controller": 11.2},
    "controller_updates": 500,
    "decoder_fit": {"labels_used": 18},
}


def rows_of(config=None, **summary):
    return as_text(training_rows(run_of(None, summary=SUMMARY | summary, config=CONFIG | (config or {}))))


def test_a_training_in_five_rows():
    assert rows_of() == {
        "labels": "20 of 40 steps; in 1 of 2 recordings",
        "planner": "500 updates in 22 s, 1 observed frame; kept update 500, with plan score 0.263 on held-out"
        " recordings (smaller is better)",
        "training ended": "with its last update; plans improved until late: more updates may help (--steps 1000)",
        "controller": "koap, 500 updates in 11 s; fitted to 18 labels",
    }


@pytest.mark.parametrize(
    ("updates", "kept", "said"),
    [
        (300, 100, "early, before update 500; plans stopped improving at update 100"),
        (500, 350, "with its last update; plans stopped improving at update 350"),
        (500, 450, "with its last update; plans improved until late: more updates may help (--steps 1000)"),
    ],
)
def test_why_a_training_ended(updates, kept, said):
    assert rows_of(planner=PLANNER | {"updates": updates, "kept_update": kept})["training ended"] == said


def test_planners_that_nothing_was_held_out_from_or_that_are_no_part_of_the_run():
    said = "20 updates in 22 s, 1 observed frame; no recording was held out"
    assert rows_of(planner={"updates": 20})["planner"] == said
    resumed = {"planner": 0.1, "controller": 0.1}
    assert rows_of(train_seconds=resumed)["controller"] == "koap, 500 updates; fitted to 18 labels"
    assert rows_of({"planner": {"source": "runs/other"}})["planner"] == "that of runs/other; not trained here"
    assert list(rows_of({"method": "dp"}, planner_parameters=0)) == ["labels", "controller"]


def test_labels_that_the_budget_left_out_are_counted():
    assert rows_of(labels=LABELS | {"available_transitions": 30})["labels"].endswith("; the data have 30 labels")


def test_numbers_without_a_unit_are_in_units_of_the_data():
    row = {"unit": "", "columns": ["q"], "controller": 0.5, "ridge": 0.6, "mean_action": 2.0}
    errors = {"left_out": {"labels": 1200, "unit": [row]}}
    (found,) = evaluation_rows(run_of(None, evaluation={"action_errors_on": "left_out", "action_errors": errors}))
    note = "root mean square in units of the data; ridge on raw frames 0.6, always the mean action 2"
    assert found == Row("action error, q", "0.5", f"{note}; 1,200 labels of recordings left out of the fit")


def test_the_largest_commands_of_a_closed_loop():
    loop = {"largest_command": 1.5, "largest_command_late": 1.25, "steps": 90, "limited_commands": 3, "commands": 1800}
    (found,) = evaluation_rows(run_of(None, evaluation={"loop": loop | {"distance_to_demonstrations": 0.5}}))
    assert found.value == "1.5 times" and "; 1.25 times in the last third; 3 of 1,800 commands limited" in found.note


def test_in_a_simulator_errors_that_were_not_measured_are_no_row():
    errors = {"outside_budget": {"note": "no labels outside the budget"}}
    assert evaluation_rows(run_of("avoiding", evaluation={"action_errors": errors})) == []


def test_successes_are_counted_and_have_modes_in_the_simulator_of_the_task_alone():
    evaluation = {"rates": {"success": {"rate": 0.29, "episodes": 100}}}  # 0.29 * 100 is below 29 in floating point
    run, elsewhere = (run_of("avoiding", evaluation=evaluation | more) for more in ({}, {"env": "mine:Base-v0"}))
    assert run.successes == 29 and run.expected_entropy and elsewhere.expected_entropy is None
