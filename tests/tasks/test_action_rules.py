# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the gripper's number from widths: recordings and plans follow one rule."""

import pytest
import torch

from torchrl_koap.tasks.action_rules import OPEN_ABOVE, PLANNED_OPEN_ABOVE, ActionRule, gripper_command

OPENS = [0.0007, 0.029, 0.056, 0.069, 0.0749, 0.078, 0.08, 0.08]
CLOSES = [0.08, 0.074, 0.066, 0.06, 0.06]
PARTLY = [0.0, 0.01, 0.02, 0.03, 0.03, 0.03, 0.03, 0.03]  # fingers that part a little and stop
HELD = [0.06, 0.0604, 0.0597, 0.0602, 0.06, 0.0601, 0.06]
STILL = [0.0801] * 6  # fingers that stay open
SHAKEN = [0.06, 0.06005, 0.06, 0.068, 0.076, 0.08, 0.08]  # measured a little wider before they open


@pytest.mark.parametrize(
    ("widths", "wanted"),
    [
        (OPENS, [0.08] * 7),
        (SHAKEN, [0.06005, 0.06, *[0.08] * 4]),
        *((own, own[1:]) for own in (CLOSES, PARTLY, HELD, STILL)),
    ],
)
def test_opening_fingers_get_the_open_command_and_others_their_next_width(widths, wanted):
    found = gripper_command(torch.tensor(widths))
    torch.testing.assert_close(found, torch.tensor(wanted), rtol=0, atol=0)
    assert (found > OPEN_ABOVE).all() == (widths in (OPENS, STILL))


def test_any_number_of_batch_dimensions_and_dtypes():
    widths = torch.tensor(OPENS, dtype=torch.float64)
    found = gripper_command(widths.expand(2, 3, -1))
    assert found.shape == (2, 3, 7) and found.dtype == torch.float64
    assert torch.equal(found[1, 2], gripper_command(widths))


def test_a_planned_opening_that_falls_short_by_millimetres_still_opens():
    planned = torch.tensor([0.0685, 0.072, 0.0745, 0.0745, 0.0745, 0.0745])
    assert (gripper_command(planned)[1:] <= OPEN_ABOVE).all()
    assert (gripper_command(planned, open_above=PLANNED_OPEN_ABOVE) > OPEN_ABOVE).all()
    rule = ActionRule(gripper=(1, 0), constants={0: 2.0})
    decoded = torch.ones(6, 2)
    assert rule(planned[:, None], decoded).tolist() == [[2.0, pytest.approx(0.08)]] * 5 + [[2.0, 1.0]]
    assert (decoded == 1).all()
    held = torch.full((6,), 0.062)
    assert (gripper_command(held, open_above=PLANNED_OPEN_ABOVE) <= OPEN_ABOVE).all()
