# This source code is licensed under the MIT license found in the LICENSE file.
"""Gripper recovery: which windows are changed, and what the gripper's number is read to be in them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import GripperRecovery
from torchrl_koap.tasks import get_task
from torchrl_koap.tasks.action_rules import PLANNED_OPEN_ABOVE, gripper_command
from torchrl_koap.training.planner import augmentation

OPEN, HELD = 0.08, 0.0617


def changed(widths, share=1.0, **options):
    window = torch.stack([torch.arange(16.0), torch.tensor(widths)], -1)
    return GripperRecovery(1, share=share, **options)(TensorDict({"state": window.clone()}, []))["state"]


def test_open_fingers_are_seen_closed_and_open_again():
    torch.manual_seed(0)
    widths = changed([OPEN] * 16)[:, 1]
    assert widths[0] == widths[1] < 0.05  # both observed frames
    assert (widths[1:].diff() > 0).all() and widths[6] > 0.075 and widths[-1] <= OPEN
    numbers = gripper_command(widths, open_above=PLANNED_OPEN_ABOVE)
    assert (numbers[1:] >= OPEN).all()  # the number that opens, from the present step on


@pytest.mark.parametrize(
    "widths",
    [
        [HELD] * 16,
        [OPEN] * 4 + [HELD] * 12,  # closes before the fingers could be open
        [HELD] * 2 + [OPEN] * 14,  # lets go of something
        [0.0, 0.03] + [OPEN] * 14,  # opens by itself, at the start of an episode
    ],
)
def test_fingers_that_hold_or_move_are_left_alone(widths):
    torch.testing.assert_close(changed(widths)[:, 1], torch.tensor(widths))


def test_a_grasp_later_in_the_window_is_still_done():
    widths = changed([OPEN] * 10 + [HELD] * 6)[:, 1]
    assert widths[0] < 0.05 and widths[8] > 0.077
    torch.testing.assert_close(widths[10:], torch.full([6], HELD))


def test_no_other_column_is_touched_and_the_share_is_kept():
    torch.manual_seed(0)
    windows = torch.full([4000, 2, 16, 3], OPEN)
    state = GripperRecovery(2, share=0.1)(TensorDict({"state": windows.clone()}, [4000, 2]))["state"]
    assert (state[..., :2] == OPEN).all()
    done = (state[..., 0, 2] < 0.05).float().mean()
    assert 0.09 < done < 0.11
    begin = state[..., 0, 2][state[..., 0, 2] < 0.05]
    assert begin.min() < 0.002 and begin.max() > 0.048


@pytest.mark.parametrize(("task", "shares"), [("stacking", [0.1]), ("stacking_1", [0.1]), ("sorting", [])])
def test_tasks_with_a_gripper_have_it_for_their_planner(task, shares):
    def found(**options):
        return [step.share for step in augmentation(get_task(task), **options).module if type(step) is GripperRecovery]

    assert found() == shares and found(actions=True) == []


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_shares_out_of_range_are_refused(value):
    with pytest.raises(ValueError, match="share and decay must be in"):
        GripperRecovery(0, share=value)


def test_hands_as_wide_as_open_ones_are_refused():
    with pytest.raises(ValueError, match="empty must be above 0 and below open_above"):
        GripperRecovery(0, empty=0.08)
