# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests plots of losses and predicted actions: contents, titles, errors of wrong input."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from run_files import run_of, titles

from torchrl_koap.reports.error_plots import (
    draw_action_errors,
    draw_actions,
    draw_losses,
    draw_plan_errors,
    running_mean,
)
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import BLUE, PALE_BLUE, RED
from torchrl_koap.tasks import Action, Task

NOTHING = run_of(None)


def test_losses_get_a_panel_each_and_zero_is_said():
    names = ("step", "loss_planner", "loss_action", "loss_new_term", "loss_koopman", "learning_rate")
    logged = ("1 1.0 - - - 1", "2 0.1 - - - 1", "3 0.1 - - - 1", "4 - 0 4 - 1", "5 - 0 2 - 1")
    rows = [dict(zip(names, row.replace("-", "").split(" "), strict=True)) for row in logged]
    figure = draw_losses(rows, NOTHING)
    assert titles(figure) == ["planner", "action decoder (labelled steps)", "new term"]
    planner, action, _ = figure.axes
    raw = planner.lines[0]
    assert raw.get_xdata().tolist() == [1, 2, 3] and raw.get_ydata().tolist() == [1.0, 0.1, 0.1]
    assert planner.lines[1].get_ydata() == pytest.approx([10 ** (-1 / 2), 10 ** (-2 / 3), 0.1])  # geometric means
    assert planner.texts[0].get_text() == "0.1"
    assert planner.get_yscale() == "log"
    assert not action.lines and "no label" in action.texts[0].get_text()
    assert action.dataLim.intervalx.tolist() == [4, 5]  # the updates of its part
    fitted = draw_losses(rows[:1] + rows[3:], replace(NOTHING, summary={"decoder_fit": {"penalty": 0.1}})).axes
    assert "fitted in closed form" in fitted[1].texts[0].get_text()
    assert fitted[0].lines[1].get_marker() == "o" and fitted[2].lines[1].get_marker() == ""  # one value, two values


def test_the_dot_marks_the_weights_that_were_kept_not_the_best_score():
    names = ("step", "held_out_score", "kept_update")
    logged = ("10 0.9 10", "15 - 10", "20 0.5 20", "30 0.52 30", "40 0.6 30")
    rows = [dict(zip(names, row.replace("-", "").split(" "), strict=True)) for row in logged]
    (scores,) = draw_losses(rows, NOTHING).axes
    dot = scores.lines[0]
    assert (dot.get_xdata()[0], dot.get_ydata()[0]) == (30, 0.52)
    assert scores.texts[0].get_text() == "kept: 0.52, update 30; last: 0.6"
    assert draw_losses(rows[:4], NOTHING).axes[0].texts[0].get_text() == "kept: 0.52, update 30"


def test_a_running_mean_skips_what_is_missing():
    np.testing.assert_allclose(running_mean(np.array([1.0, np.nan, 3.0, 5.0]), 1), [1, 2, 4, 4])


@pytest.mark.parametrize(
    ("rows", "message"),
    [([], "no row"), ([{"step": "1", "loss_a": "x"}], "float")],
)
def test_bad_metrics(rows, message):
    with pytest.raises(ValueError, match=message):
        draw_losses(rows, NOTHING)


def test_actions_tell_the_error_and_what_they_are_read_for():
    true = np.zeros((50, 2))
    predicted = np.tile([0.003, 0.004], (50, 1))
    figure = draw_actions({"predicted": predicted, "true": true}, run_of("avoiding"))
    assert titles(figure) == ["x: RMSE 3 mm", "y: RMSE 4 mm"]
    assert figure.get_suptitle() == "50 steps of demonstrations outside the label budget, for evaluation only"


def test_actions_of_another_robot():
    """Seven joint torques: names and units as given, nothing speaks of x, y or mm."""
    true = np.random.rand(30, 7)
    data, torques = {"predicted": true + 0.5, "true": true}, {f"torque {index}": Action("N m") for index in range(7)}
    arm = Task(name="arm", observation_parts={"q": 7}, actions=torques, position="q")
    assert titles(draw_actions(data, RunFacts(Path("run"), arm)))[6:] == ["torque 6: RMSE 0.5 N m"]
    figure = draw_actions(data, NOTHING)
    assert titles(figure)[0] == "action 1: RMSE 0.5" and figure.axes[0].get_xlabel().endswith("(per step)")
    speeds = {"forward": Action("m/s"), "a_very_long_name_of_a_turn": Action("rad"), "grip": Action("m", "gripper")}
    base = Task(name="base", observation_parts={"q": 7}, actions=speeds, position="q")
    drawn = draw_actions({name: value[:, :3] for name, value in data.items()}, RunFacts(Path("run"), base)).axes
    assert drawn[0].get_xlabel() == "recorded forward (m/s)"  # no second "per"
    assert drawn[1].get_xlabel() == "recorded a_very_l…f_a_turn (mrad per step)"
    assert drawn[2].get_xlabel() == "recorded grip (mm)"  # a width, not a change


def test_actions_that_do_not_belong_together():
    with pytest.raises(ValueError, match=r"'predicted' must have shape \[4, 2\]"):
        draw_actions({"predicted": np.zeros((3, 2)), "true": np.zeros((4, 2))}, NOTHING)


def test_errors_of_plans_by_planned_step():
    row = {"unit": "m", "columns": ["x", "y"]}
    for place, name in enumerate(("planner", "standing_still", "constant_velocity")):
        row[name] = {
            "energy_score": {"per_step": [0.001, 0.002 + place]},
            "best_of": {"per_step": [0.003 + place, 0.004]},
        }
    left, right = draw_plan_errors({"plan_errors": {"unit": [row], "samples": 8}}, run_of("avoiding")).axes
    assert [line.get_xdata().tolist() for line in left.lines] == [[1, 2]] * 3
    assert left.lines[1].get_ydata() == pytest.approx([1, 1002]) and right.lines[2].get_ydata() == pytest.approx(
        [2003, 4]
    )
    assert (left.get_ylabel(), left.get_xlabel()) == ("distance (mm)", "planned step, 35 ms each")


def test_errors_of_actions_are_shares_so_that_small_ones_can_be_read():
    rows = [
        {"name": "dx", "unit": "m", "controller": 0.0005, "ridge": 0.003, "mean_action": 0.002},
        {"name": "gripper", "unit": "", "controller": 0.6, "mean_action": 0.5},
        {"name": "still", "unit": "", "controller": 0.0, "ridge": 0.0, "mean_action": 0.0},
    ]
    figure = draw_action_errors(
        {"action_errors": {"left_out": {"labels": 9, "trajectories": 2, "column": rows}}}, NOTHING
    )
    (axes,) = figure.axes
    heights = [bar.get_height() for bar in axes.patches]
    assert heights == pytest.approx([0.25, 1.2, math.nan, 1.5, math.nan, math.nan], nan_ok=True)
    colors = [to_hex(bar.get_facecolor()) for bar in axes.patches]
    assert [colors[0], colors[1], colors[3]] == [BLUE.lower(), RED.lower(), PALE_BLUE.lower()]
    assert axes.lines[0].get_ydata() == [1, 1]  # always the mean action
    rows[1]["controller"] = 0.4
    still = draw_action_errors(
        {"action_errors": {"left_out": {"labels": 1, "trajectories": 1, "column": rows}}}, NOTHING
    )
    said = [text.get_text() for text in still.axes[0].get_legend().get_texts()]
    assert said == ["controller", "ridge on raw frames", "always the mean action"]  # nothing red, nothing said of it
    assert still.axes[0].get_title(loc="left").endswith("1 labels of 1 recording")
    assert [label.get_text() for label in axes.get_xticklabels()] == ["dx\n0.5 mm", "gripper\n0.6", "still\n0"]
