# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that advice follows from the numbers, and that absent or good numbers give none."""

import shlex
from pathlib import Path

import pytest

from torchrl_koap.commands.options import parse
from torchrl_koap.commands.subcommands import Subcommand
from torchrl_koap.evaluation.findings import EXPERIMENTS
from torchrl_koap.reports.advice import advice
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import get_task

AVOIDING = get_task("avoiding")  # 57 episodes without preferences have an entropy of 0.93; a control step takes 35 ms


def inspected(*shares):
    return {name: {"rate": rate} for name, rate in zip(EXPERIMENTS, shares, strict=True)}


def found(**numbers):
    return list(advice(RunFacts(Path("run"), **numbers)))


def rates(success, **more):
    return {"rates": {"success": {"rate": success, "low": success, "high": success, "episodes": 60} | more}}


def actions(own, ridge):
    errors = {"left_out": {"relative": own, "ridge_relative": ridge}}
    return {"action_errors_on": "left_out", "action_errors": errors}


def labelled(count):
    return {"summary": {"labels": {"labelled_transitions": count}}, "config": {"method": "koap"}}


def commands(**numbers):
    return [item.command for item in found(**numbers)]


GOOD = rates(0.95, low=0.86, high=0.98) | {"mode_entropy": 0.9} | actions(0.1, 0.3)
SUCCEEDS = {"task": AVOIDING, "config": {"method": "koap"}, "evaluation": GOOD}
FEW = rates(0.95) | {"mode_entropy": 0.3}


@pytest.mark.parametrize(
    ("numbers", "wanted"),
    [
        ({}, []),
        (SUCCEEDS | {"summary": {"labels": {"labelled_transitions": 80}}}, []),
        ({"evaluation": rates(0.5)}, ["koap inspect {run}"]),
        ({"evaluation": rates(0.5) | {"env": "mine:Base-v0"}}, ["koap eval {run} --out {run}_recorded"]),
        ({"evaluation": rates(0.5), "summary": {"planner_parameters": 0}}, []),  # a policy of its own
        ({"evaluation": rates(0.0) | {"env": "mine:Walker-v0"}}, []),  # success is not defined
        ({"evaluation": rates(0.5), **labelled(299)}, ["koap inspect {run}", "koap suggest {run} --count 5"]),
        ({"evaluation": rates(0.5), **labelled(300)}, ["koap inspect {run}"]),
        ({"evaluation": FEW, "task": AVOIDING, "summary": {"planner_parameters": 0}}, [""]),  # another method
        ({"inspection": inspected(0.95, 0.95, 0.9)}, []),  # the loop is hardly worse than its parts
        ({"evaluation": FEW, "task": AVOIDING}, ["koap inspect {run}"]),
        ({"evaluation": FEW | {"mode_entropy": 0.8}, "task": AVOIDING}, []),
        ({"evaluation": FEW | {"pooled_mode_entropy": 0.9}, "task": AVOIDING}, []),  # few rollouts per context
        ({"evaluation": FEW}, []),  # modes of which nothing is known
        ({"evaluation": {"plan_ms": 40.0}, "task": AVOIDING}, ["koap latency {run}"]),
        ({"evaluation": {"plan_ms": 30.0}, "task": AVOIDING}, []),
    ],
)
def test_what_is_proposed(numbers, wanted):
    assert commands(**numbers) == wanted


@pytest.mark.parametrize(
    ("shares", "words"),
    [
        ((0.6, 0.95, 0.5), "the planner fails"),
        ((0.95, 0.5, 0.4), "the controller fails"),
        ((0.95, 0.95, 0.4), "leave the planner's training data"),
    ],
)
def test_the_part_that_fails_is_named(shares, words):
    (item,) = found(evaluation=rates(shares[2]), inspection=inspected(*shares))
    assert words in item.finding


def test_a_controller_that_stays_near_recorded_tool_paths_is_not_what_fails():
    """Where things are pushed, recorded actions do not answer to where they went: its success says little."""
    inspection = inspected(0.95, 0.3, 0.4) | {"recordings_left": {"count": 3, "episodes": 60}}
    (item,) = found(evaluation=rates(0.4), inspection=inspection)
    assert "leave the planner's training data" in item.finding


def test_more_labels_are_not_proposed_where_the_planner_fails():
    numbers = labelled(80) | {"evaluation": rates(0.5)}
    assert "koap suggest {run} --count 5" not in commands(**numbers, inspection=inspected(0.6, 0.9, 0.5))


def test_a_ridge_that_errs_less_is_pointed_out():
    (item,) = found(config={"method": "koap"}, evaluation=actions(0.32, 0.31))
    assert item.finding == "the action error of koap is 0.32 times the mean action's, of a ridge on raw frames 0.31"
    assert not found(config={"method": "linear"}, evaluation=actions(0.3, 0.3))
    call = shlex.split(item.command.format(data="arm"))
    study = parse(Subcommand, call[1:]).config
    assert study.methods == ("koap", "koap_untrained", "linear_steps", "linear") and study.datasets == ("arm",)


def test_wide_intervals_come_last():
    evaluation = rates(0.5, low=0.2, high=0.8, episodes=8)
    assert commands(evaluation=evaluation)[-1] == "koap eval {run} --episodes 60 --seed 100"
