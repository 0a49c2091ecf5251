# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that findings about a run follow from its numbers."""

import pytest

from torchrl_koap.evaluation.findings import EXPERIMENTS, describe_inspection
from torchrl_koap.tasks import get_task


@pytest.mark.parametrize(
    ("rates", "words"),
    [
        ((0.5, 1.0, 1.0), "no fault found"),
        ((0.5, 1.0, 0.4), "the planner alone reaches the goal in only 50%"),
        ((1.0, 0.3, 0.4), "the controller follows recorded states to the goal in only 30%"),
        ((1.0, 1.0, 0.4), "planner and controller work alone, not together"),
    ],
)
def test_findings(rates, words):
    result = {name: {"rate": value} for name, value in zip(EXPERIMENTS, rates, strict=True)}
    assert describe_inspection(result | {"distance_to_demonstrations": {}}, get_task("avoiding")).startswith(words)


@pytest.mark.parametrize(
    ("left", "words"),
    [(1, "planner and controller work alone"), (2, "the controller leaves 2 of 10 recorded tool paths by more than")],
)
def test_the_controller_is_named_only_if_it_leaves_several_recorded_tool_paths(left, words):
    rates = {"planner_alone": 1.0, "controller_alone": 0.0, "both": 0.4}
    result = {name: {"rate": value} for name, value in rates.items()}
    result |= {"distance_to_demonstrations": {}, "recordings_left": {"count": left, "episodes": 10}}
    assert describe_inspection(result, get_task("sorting")).startswith(words)


@pytest.mark.parametrize(
    ("followed", "words"), [(0.3, "the controller follows recorded states"), (1.0, "the controller works alone")]
)
def test_findings_without_a_goal(followed, words):
    result = {"controller_alone": {"rate": followed}, "both": {"rate": 0.4}, "distance_to_demonstrations": {}}
    assert describe_inspection(result, get_task("scooping")).startswith(words)
