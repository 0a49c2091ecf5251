# This source code is licensed under the MIT license found in the LICENSE file.
"""The controllers KOAP is compared with: exact on a linear system, aligned in time, blind to hidden labels."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import LinearInverseDynamics, Normalizer, RecurrentInverseDynamics, SupervisedInverseDynamics

MAKERS = (LinearInverseDynamics, RecurrentInverseDynamics, SupervisedInverseDynamics)


def linear_windows(*batch, frames=12, look_ahead=5, num_past=2, dtype=torch.float64, seed=0):
    """Actions that are a fixed affine map of x_{t-2}, x_{t-1}, x_t, x_{t+5}, where these lie in the window."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(*batch, frames, 3, generator=generator, dtype=torch.float64)
    true = torch.randn(2, 4 * 3, generator=torch.Generator().manual_seed(99), dtype=torch.float64)
    action = torch.full((*batch, frames, 2), torch.nan, dtype=torch.float64)
    for t in range(num_past, frames - look_ahead):
        read = torch.cat([state[..., t - 2, :], state[..., t - 1, :], state[..., t, :], state[..., t + 5, :]], -1)
        action[..., t, :] = read @ true.T + torch.tensor([0.5, -2.0])
    return TensorDict({"state": state.to(dtype), "action": action.to(dtype)}, batch)


def test_ridge_recovers_a_linear_system_and_generalises():
    model = LinearInverseDynamics(3, 2, num_past=2, look_ahead=5).double()
    windows = linear_windows(40)
    fit = model.fit_decoder(windows, torch.ones(40, 12, dtype=torch.bool))
    assert fit.num_labels == 40 * 5  # frames 2..6 see everything
    unseen = linear_windows(6, 2, seed=1)
    predicted = model(unseen.clone())["action"]
    torch.testing.assert_close(predicted[..., 2:7, :], unseen["action"][..., 2:7, :], atol=1e-4, rtol=0)


def test_ridge_reads_no_action_outside_the_mask():
    windows, mask = linear_windows(40), torch.zeros(40, 12, dtype=torch.bool)
    mask[:5] = True
    models = [LinearInverseDynamics(3, 2, num_past=2, look_ahead=5).double() for _ in range(2)]
    models[0].fit_decoder(windows, mask)
    poisoned = windows.clone()
    poisoned["action"][5:] = 1e9
    models[1].fit_decoder(poisoned, mask, groups=torch.arange(40))
    models[1].fit_decoder(poisoned, mask)
    for name, value in models[0].state_dict().items():
        assert torch.equal(value, models[1].state_dict()[name]), name
    with pytest.raises(ValueError, match="at least one labelled step"):
        models[0].fit_decoder(windows, torch.zeros_like(mask))


def test_groups_are_left_out_together():
    """With the same action all over a group, leaving out single steps looks better than leaving out the group."""
    generator = torch.Generator().manual_seed(0)
    windows = linear_windows(30)
    windows["action"] = torch.randn(30, 1, 2, generator=generator, dtype=torch.float64).expand(30, 12, 2).clone()
    windows["state"] = windows["state"] * 0.01 + torch.randn(30, 1, 3, generator=generator, dtype=torch.float64)
    mask = torch.ones(30, 12, dtype=torch.bool)
    errors = [
        min(
            LinearInverseDynamics(3, 2, num_past=2, look_ahead=5)
            .double()
            .fit_decoder(windows, mask, groups=g)
            .errors.values()
        )
        for g in (None, torch.arange(30))
    ]
    assert errors[1] > errors[0]


def test_constant_columns_do_not_disturb_the_ridge():
    windows = linear_windows(40)
    constant = torch.full((40, 12, 1), 7.0, dtype=torch.float64)
    wide = TensorDict({"state": torch.cat([windows["state"], constant], -1), "action": windows["action"]}, [40])
    model = LinearInverseDynamics(4, 2, num_past=2, look_ahead=5).double()
    model.fit_decoder(wide, torch.ones(40, 12, dtype=torch.bool))
    predicted = model(wide.clone())["action"][:, 2:7]
    torch.testing.assert_close(predicted, windows["action"][:, 2:7], atol=1e-4, rtol=0)


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_dimensions_types_keys_and_state_dict(make, dtype):
    torch.manual_seed(0)
    model = make(3, 2, in_key=("in", "x"), out_key=("out", "a")).to(dtype)
    state = torch.randn(2, 4, 12, 3, dtype=dtype)
    action = model(TensorDict({"in": {"x": state}}, [2, 4]))["out", "a"]
    assert action.shape == (2, 4, 12, 2) and action.dtype == dtype
    single = model(TensorDict({"in": {"x": state[1, 3]}}, []))["out", "a"]
    torch.testing.assert_close(single, action[1, 3])
    assert list(model.in_keys) == [("in", "x")] and list(model.out_keys) == [("out", "a")]
    torch.manual_seed(1)
    other = make(3, 2).to(dtype)
    other.load_state_dict(model.state_dict())
    torch.testing.assert_close(other(TensorDict({"state": state}, [2, 4]))["action"], action, rtol=0, atol=0)
    assert model.num_window_frames == model.num_past + (9 if make is LinearInverseDynamics else 2)


def test_recurrent_action_depends_on_everything_up_to_the_next_state_and_nothing_later():
    torch.manual_seed(0)
    model = RecurrentInverseDynamics(3, 2, hidden_dim=8)
    state = torch.randn(1, 6, 3, requires_grad=True)
    for frame in range(5):
        action = model(TensorDict({"state": state}, [1]))["action"]
        (gradient,) = torch.autograd.grad(action[0, frame].sum(), state)
        reached = (gradient[0].abs().sum(-1) > 0).tolist()
        assert reached == [index <= frame + 1 for index in range(6)]
    assert torch.equal(action[0, 5], action[0, 4])  # there is no x_6: the last one is repeated


def test_recurrent_normalisers_are_applied_on_both_sides():
    torch.manual_seed(0)
    plain = RecurrentInverseDynamics(3, 2, hidden_dim=8)
    shift, scale = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 4.0, 8.0])
    out_shift, out_scale = torch.tensor([5.0, 6.0]), torch.tensor([0.5, 0.25])
    model = RecurrentInverseDynamics(
        3,
        2,
        hidden_dim=8,
        state_normalizer=Normalizer(shift, scale),
        action_normalizer=Normalizer(out_shift, out_scale),
    )
    model.load_state_dict(plain.state_dict(), strict=False)
    state = torch.randn(4, 6, 3)
    expected = plain(TensorDict({"state": state}, [4]))["action"] * out_scale + out_shift
    actual = model(TensorDict({"state": state * scale + shift}, [4]))["action"]
    torch.testing.assert_close(actual, expected)


def test_look_ahead_of_the_next_state_is_refused():
    """A ridge may not be told the next state, as KOAP may not; the supervised network may."""
    assert SupervisedInverseDynamics(2, 2, look_ahead=1).num_window_frames == 6
    with pytest.raises(ValueError, match="must be >= 2"):
        LinearInverseDynamics(2, 2, look_ahead=1)


@pytest.mark.parametrize("look_ahead", [(1,), (1, 3)])
def test_supervised_action_depends_on_its_frames_and_no_others(look_ahead):
    torch.manual_seed(0)
    model = SupervisedInverseDynamics(3, 2, hidden_dims=(8,), num_past=2, look_ahead=look_ahead)
    state = torch.randn(1, 9, 3, requires_grad=True)
    assert model.span(9) == range(2, 9 - look_ahead[-1])
    for frame in model.span(9):
        action = model(TensorDict({"state": state}, [1]))["action"]
        (gradient,) = torch.autograd.grad(action[0, frame].sum(), state)
        reached = (gradient[0].abs().sum(-1) > 0).nonzero().flatten().tolist()
        assert reached == [frame - 2, frame - 1, frame, *(frame + offset for offset in look_ahead)]


def test_supervised_network_normalises_both_sides_and_scales_steps():
    torch.manual_seed(0)
    plain = SupervisedInverseDynamics(3, 2, hidden_dims=(8,))
    shift, scale = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 4.0, 8.0])
    model = SupervisedInverseDynamics(
        3,
        2,
        hidden_dims=(8,),
        state_normalizer=Normalizer(shift, scale),
        action_normalizer=Normalizer(torch.tensor([5.0, 6.0]), torch.tensor([0.5, 0.25])),
    )
    model.load_state_dict(plain.state_dict(), strict=False)
    state = torch.randn(4, 12, 3).cumsum(1)
    plain.fit_scales(state)
    model.fit_scales(state * scale + shift)
    torch.testing.assert_close(model.reader.scales, plain.reader.scales)
    expected = plain(TensorDict({"state": state}, [4]))["action"] * torch.tensor([0.5, 0.25]) + torch.tensor([5.0, 6.0])
    actual = model(TensorDict({"state": state * scale + shift}, [4]))["action"]
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)
