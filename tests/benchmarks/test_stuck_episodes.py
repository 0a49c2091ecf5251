# This source code is licensed under the MIT license found in the LICENSE file.
"""How an episode that ran out of time is counted."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.tasks import get_task

STEPS = 300


@pytest.fixture(scope="module")
def script(benchmark_script):
    return benchmark_script("stuck_episodes")


def episode(task, speed=0.0, followed=1.0, width=0.08, pushed=0.0):
    """A tool that is told to go on, and follows in part; the object moves with it."""
    action = torch.zeros(STEPS, get_task(task).action_dim)
    action[:, 0] = speed
    if "gripper" in get_task(task).actions:
        action[:, get_task(task).action_names.index("gripper")] = width
    tool = torch.zeros(STEPS + 1, 2)
    tool[1:, 0] = followed * speed * torch.arange(1, STEPS + 1)
    return action, tool, (pushed * tool).unsqueeze(1)


@pytest.mark.parametrize(
    ("task", "given", "expected"),
    [
        ("sorting", {"speed": 0.002, "followed": 0.1}, "runaway"),
        ("sorting", {"speed": 0.002}, "moving"),
        ("sorting", {"speed": 0.0002}, "one place"),
        ("sorting", {"speed": 0.0002, "pushed": 1.0}, "moving"),
        ("stacking", {"width": 0.007}, "fingers"),
        ("stacking", {"width": 0.062}, "one place"),
        ("stacking_unobserved_joints", {"width": 0.007}, "fingers"),
        ("stacking", {"speed": 0.002}, "moving"),  # its actions move joints: nothing runs away from the tool
    ],
)
def test_an_episode_is_counted_under_the_first_that_fits(script, task, given, expected):
    assert script.way_out(get_task(task), *episode(task, **given)) == expected
