# This source code is licensed under the MIT license found in the LICENSE file.
"""The command in a state: scales, what is read, and weights that can be saved."""

import pytest
import torch

from torchrl_koap.modules import CommandPosture


class Gap(torch.nn.Module):
    """From the last two columns to the first two."""

    num_features = 2

    def forward(self, history):
        return history[..., -1, :2] - history[..., -1, 2:]


GAP = Gap()


def a_posture(**options) -> CommandPosture:
    torch.manual_seed(0)
    posture = CommandPosture(4, [0, 1, 2], [1, 2, 3], width=8, **options)
    posture.set_scales(torch.randn(50, 4), 5 + 0.1 * torch.randn(50, 3))
    return posture


@pytest.mark.parametrize("batch", [(), (3,), (2, 0, 4)])
def test_any_number_of_batch_dimensions(batch):
    assert a_posture(features=GAP)(torch.randn(*batch, 4)).shape == (*batch, 3)


def test_commands_come_out_in_their_own_unit():
    assert (a_posture()(torch.randn(9, 4)) - 5).abs().max() < 1


def test_relative_places_are_read():
    states = torch.randn(5, 4)
    moved = states + torch.tensor([1.0, 0.0, 1.0, 0.0])  # the gap stays
    posture = a_posture(features=GAP)
    assert posture._read(states).shape[-1] == 6
    torch.testing.assert_close(posture._read(states)[:, 4:], posture._read(moved)[:, 4:], atol=1e-5, rtol=1e-5)


def test_weights_and_scales_are_saved():
    posture, fresh = a_posture(features=GAP), CommandPosture(4, [0, 1, 2], [1, 2, 3], features=GAP, width=8)
    fresh.load_state_dict(posture.state_dict())
    states = torch.randn(5, 4)
    assert torch.equal(posture(states), fresh(states))


def test_double_precision():
    states = torch.randn(5, 4, dtype=torch.float64)
    assert a_posture().double()(states).dtype == torch.float64


@pytest.mark.parametrize(
    ("arguments", "named"),
    [(((0, [0], [0])), "state_dim"), ((2, [], []), "commands"), ((2, [0, 1], [0]), "2 columns of commands and 1")],
)
def test_sizes_are_refused_by_name(arguments, named):
    with pytest.raises(ValueError, match=named):
        CommandPosture(*arguments)
