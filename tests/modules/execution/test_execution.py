# This source code is licensed under the MIT license found in the LICENSE file.
"""Execution options: which are accepted, and what a method fills in."""

import dataclasses

import pytest

from torchrl_koap.modules import Execution, ExecutionConfig


def test_given_values_replace_and_none_does_not():
    own = Execution(blend=0.5, lead=0.1)
    assert own.replaced(strategy="open_loop", blend=0.0, lead=None) == Execution("open_loop", blend=0.0, lead=0.1)
    assert own.replaced() == own
    assert Execution(**dataclasses.asdict(own)) == own
    assert own.replaced(lead=0.0, temperature=0.0, limits=0.0) == Execution(blend=0.5, temperature=0.0, limits=0.0)


def test_missing_values_are_the_defaults():
    default = Execution(strategy="open_loop", replan_interval=8, blend=0.0)
    assert ExecutionConfig().on(default) == default
    assert ExecutionConfig(blend=0.4, gain=1.5).on(default) == dataclasses.replace(default, blend=0.4, gain=1.5)


@pytest.mark.parametrize("kind", [Execution, ExecutionConfig])
@pytest.mark.parametrize(
    "asked, problem",
    [
        ({"strategy": "open-loop"}, "unknown strategy 'open-loop'; did you mean 'open_loop'?"),
        ({"replan_interval": 0}, "replan_interval must be an integer >= 1, got 0"),
        ({"replan_interval": 2.5}, "replan_interval must be an integer >= 1, got 2.5"),
        ({"candidates": 0}, "candidates must be an integer >= 1, got 0"),
        ({"candidates": True}, "candidates must be an integer >= 1, got True"),
        ({"blend": 1.0}, r"blend must be in \[0, 1\), got 1.0"),
        ({"blend": float("nan")}, "blend must be in"),
        ({"lead": -0.1}, "lead must be a number >= 0, got -0.1"),
        ({"lead": float("inf")}, "lead must be a number >= 0"),
        ({"gain": 0.0}, "gain must be a number above 0, got 0.0"),
        ({"gain": float("inf")}, "gain must be a number above 0, got inf"),
        ({"temperature": -0.1}, r"temperature must be in 0..1, got -0.1"),
        ({"limits": -0.1}, "limits must be a number >= 0, or infinity, got -0.1"),
        ({"temperature": 1.1}, "temperature must be in 0..1"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(kind, asked, problem):
    with pytest.raises(ValueError, match=problem):
        kind(**asked)


def test_an_unknown_field_suggests_the_nearest():
    with pytest.raises(ValueError, match="unknown option of an execution 'blent'; did you mean 'blend'?"):
        Execution().replaced(blent=0.0)
