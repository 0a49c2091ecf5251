# This source code is licensed under the MIT license found in the LICENSE file.
"""The gripper's number from widths: labels of recordings and commands of plans follow one rule."""

from __future__ import annotations

import torch

from torchrl_koap.tasks.action_rules import OPEN_ABOVE, PLANNED_OPEN_ABOVE, gripper_command

OPENS = torch.tensor([0.0007, 0.029, 0.056, 0.069, 0.0749, 0.078, 0.08, 0.08])


def test_an_opening_gripper_is_told_to_open_all_the_time():
    assert gripper_command(OPENS).tolist() == torch.full((7,), 0.08).tolist()
    assert (gripper_command(OPENS) > OPEN_ABOVE).all()


def test_a_closing_gripper_gets_its_next_width():
    closes = torch.tensor([0.08, 0.074, 0.066, 0.06, 0.06])
    assert torch.equal(gripper_command(closes), closes[1:])


def test_a_held_box_does_not_open_and_an_open_gripper_does_not_close():
    held = 0.06 + torch.tensor([0.0, 4e-4, -3e-4, 2e-4, 0.0, 1e-4, 0.0])
    assert (gripper_command(held) < OPEN_ABOVE).all()
    still = torch.full((6,), 0.0801)
    assert (gripper_command(still) > OPEN_ABOVE).all()


def test_fingers_that_part_a_little_and_stop_are_not_opening():
    partly = torch.tensor([0.0, 0.01, 0.02, 0.03, 0.03, 0.03, 0.03, 0.03])
    assert torch.equal(gripper_command(partly), partly[1:])


def test_any_number_of_batch_dimensions_and_dtypes():
    batch = OPENS.double().expand(2, 3, -1)
    found = gripper_command(batch)
    assert found.shape == (2, 3, 7) and found.dtype == torch.float64
    assert torch.equal(found[1, 2], gripper_command(OPENS.double()))


def test_a_planned_opening_that_falls_short_by_millimetres_still_opens():
    planned = torch.tensor([0.0685, 0.072, 0.0745, 0.0745, 0.0745, 0.0745])
    assert (gripper_command(planned)[1:] <= OPEN_ABOVE).all()
    assert (gripper_command(planned, open_above=PLANNED_OPEN_ABOVE) > OPEN_ABOVE).all()
    held = torch.full((6,), 0.062)
    assert (gripper_command(held, open_above=PLANNED_OPEN_ABOVE) <= OPEN_ABOVE).all()
