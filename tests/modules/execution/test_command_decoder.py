# This source code is licensed under the MIT license found in the LICENSE file.
"""The command in a state: scales, what is read, and weights that can be saved."""

import pytest
import torch

from torchrl_koap.modules import CommandDecoder, CommandRegression, blend_plan


class Gap(torch.nn.Module):
    """From the last two columns to the first two."""

    num_features = 2

    def forward(self, history):
        return history[..., -1, :2] - history[..., -1, 2:]


GAP = Gap()


def a_decoder(**options) -> CommandDecoder:
    torch.manual_seed(0)
    decoder = CommandDecoder(4, [0, 1, 2], [1, 2, 3], width=8, **options)
    decoder.set_scales(torch.randn(50, 4), 5 + 0.1 * torch.randn(50, 3))
    return decoder


@pytest.mark.parametrize("batch", [(), (3,), (2, 0, 4)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_batch_dimensions_and_dtype(batch, dtype):
    commands = a_decoder(features=GAP).to(dtype)(torch.randn(*batch, 4, dtype=dtype))
    assert commands.shape == (*batch, 3) and commands.dtype == dtype


def test_commands_come_out_in_their_own_unit():
    assert (a_decoder()(torch.randn(9, 4)) - 5).abs().max() < 1


def test_relative_places_are_read():
    states = torch.randn(5, 4)
    moved = states + torch.tensor([1.0, 0.0, 1.0, 0.0])  # the gap stays
    decoder = a_decoder(features=GAP)
    assert decoder._read(states).shape[-1] == 6
    torch.testing.assert_close(decoder._read(states)[:, 4:], decoder._read(moved)[:, 4:], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [(((0, [0], [0])), "state_dim"), ((2, [], []), "commands"), ((2, [0, 1], [0]), "2 columns of commands and 1")],
)
def test_sizes_are_refused_by_name(arguments, named):
    with pytest.raises(ValueError, match=named):
        CommandDecoder(*arguments)


# ---- plans that are followed by it


class Known(CommandDecoder):
    """Two commands of a state ``x, width``: the first moves x, the second ought to be twice x and is not seen."""

    def __init__(self):
        super().__init__(2, [0, 1], [0, 1], action_dim=3, width=4)

    def forward(self, states):
        return torch.stack([states[..., 0], 2 * states[..., 0]], -1)


def changes(command, now, plan, steps=1):
    """Actions ``[*B, steps, 3]`` under a plan as it is."""
    follower = CommandRegression(Known(), blend=0.0)
    return follower(command.unsqueeze(-2), now.unsqueeze(-2), plan, steps)


def test_a_joint_that_is_not_seen_comes_back():
    command, x = torch.tensor([0.0, 1.5]), torch.zeros(2)
    plan = torch.stack([torch.linspace(0.01, 0.14, 14), torch.zeros(14)], -1)
    for _ in range(40):
        command = command + changes(command, x, plan - plan[:1] + x + torch.tensor([0.01, 0.0]))[0, :2]
        x = torch.stack([command[0], x[1]])  # what is seen follows the first command
    assert x[0] == pytest.approx(0.4, abs=1e-4)
    assert command[1] == pytest.approx(0.8, abs=1e-3)  # it began 1.5 away


def test_without_feedback_it_stays_where_it_strayed(monkeypatch):
    monkeypatch.setattr("torchrl_koap.modules.execution.command_decoder.FEEDBACK_GAIN", 0.0)
    assert not changes(torch.tensor([0.0, 1.5]), torch.zeros(2), torch.zeros(14, 2)).any()


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_several_steps_sum_up_to_the_command_at_the_end(batch):
    plan, now = torch.randn(*batch, 6, 2), torch.randn(*batch, 2)
    decoded = Known()(now)
    action = changes(decoded, now, plan, steps=6)
    assert action.shape == (*batch, 6, 3) and not action[..., 2].any()  # the third is no rule's either
    torch.testing.assert_close(decoded + action[..., :2].sum(-2), Known()(plan[..., -1, :]))
    torch.testing.assert_close(changes(decoded, now, plan)[..., 0, :], action[..., 0, :])


def test_other_entries_are_the_rules_and_the_plan_is_bent():
    follower = CommandRegression(Known(), blend=0.5, action_rule=lambda states, actions: actions + states[..., 1:])
    now, plan = torch.tensor([[0.1, 0.02]]), torch.randn(14, 2)
    action = follower(torch.zeros(1, 2), now, plan)
    assert action[0, 2] == now[0, 1]
    bent = blend_plan(now, plan, 0.5)[:1]
    torch.testing.assert_close(action[:, :2], changes(torch.zeros(2), now[0], bent)[:, :2])
