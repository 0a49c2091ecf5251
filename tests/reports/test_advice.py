# This source code is licensed under the MIT license found in the LICENSE file.
"""What to try next follows from the numbers, and nothing is said where they are absent or good."""

from __future__ import annotations

import pytest

from torchrl_koap.reports.advice import RULES, Numbers, advice


def inspected(imagined, followed, closed):
    return {
        name: {"rate": rate}
        for name, rate in (("imagined", imagined), ("followed", followed), ("closed_loop", closed))
        if rate is not None
    }


def commands(**numbers):
    return [item.command for item in advice(Numbers(**numbers))]


def test_nothing_is_known_and_nothing_is_said():
    assert advice(Numbers()) == []


def test_a_run_that_succeeds_in_many_ways_needs_nothing():
    evaluation = {"success_rate": 0.95, "success_low": 0.86, "success_high": 0.98, "episodes": 60, "mode_entropy": 0.9}
    summary = {"labels": {"labelled_transitions": 80}, "action_error_mm": {"controller": 1.0, "ridge": 3.0}}
    assert commands(config={"method": "koap"}, summary=summary, evaluation=evaluation, even_entropy=0.93) == []


def test_failure_without_inspection_asks_for_one():
    assert commands(evaluation={"success_rate": 0.5, "episodes": 60}) == ["koap inspect {run}"]


def test_a_policy_of_its_own_cannot_be_inspected():
    assert commands(summary={"planner_parameters": 0}, evaluation={"success_rate": 0.5, "episodes": 60}) == []


@pytest.mark.parametrize(
    ("rates", "words"),
    [
        ((0.6, 0.95, 0.5), "the planner is what fails"),
        ((0.95, 0.5, 0.4), "the controller is what fails"),
        ((0.95, 0.95, 0.4), "leave what the planner was trained on"),
    ],
)
def test_the_part_that_fails_is_named(rates, words):
    (found,) = advice(Numbers(evaluation={"success_rate": rates[2], "episodes": 60}, inspection=inspected(*rates)))
    assert words in found.finding


def test_more_labels_are_not_proposed_where_the_planner_fails():
    numbers = {
        "config": {"method": "koap"},
        "summary": {"labels": {"labelled_transitions": 80}},
        "evaluation": {"success_rate": 0.5, "episodes": 60},
    }
    assert "koap suggest {run} --count 5" in commands(**numbers)
    assert "koap suggest {run} --count 5" not in commands(**numbers, inspection=inspected(0.6, 0.9, 0.5))


@pytest.mark.parametrize(("candidates", "command"), [(8, "koap eval {run} --candidates 1"), (1, "koap inspect {run}")])
def test_low_entropy(candidates, command):
    evaluation = {"success_rate": 0.95, "episodes": 60, "mode_entropy": 0.3, "candidates": candidates}
    assert commands(evaluation=evaluation, even_entropy=0.93) == [command]
    assert commands(evaluation=evaluation | {"mode_entropy": 0.8}, even_entropy=0.93) == []


def test_a_ridge_that_errs_less_is_pointed_out():
    numbers = Numbers(config={"method": "koap"}, summary={"action_error_mm": {"controller": 3.2, "ridge": 3.1}})
    assert [item.finding for item in advice(numbers)] == [
        "the action error of koap is 3.2 mm, that of a plain ridge 3.1 mm"
    ]
    assert not advice(Numbers(config={"method": "linear"}, summary={"action_error_mm": {"controller": 3, "ridge": 3}}))


def test_recorded_data():
    assert "1.20 times as far" in advice(Numbers(evaluation={"relative_plan_error": 1.2}))[0].finding
    assert "1.10 times as much" in advice(Numbers(evaluation={"relative_action_error": 1.1}))[0].finding
    assert not advice(Numbers(evaluation={"relative_plan_error": 0.4, "relative_action_error": 0.2}))


def test_slow_plans():
    assert commands(config={"control_hz": 30}, evaluation={"plan_ms": 40.0}) == ["koap latency {run}"]
    assert commands(config={"control_hz": 20}, evaluation={"plan_ms": 40.0}) == []


def test_wide_intervals_come_last():
    evaluation = {"success_rate": 0.5, "success_low": 0.2, "success_high": 0.8, "episodes": 8}
    assert commands(evaluation=evaluation)[-1] == "koap eval {run} --episodes 60 --seed 100"
    assert RULES[-1].__name__ == "few_rollouts"
