# This source code is licensed under the MIT license found in the LICENSE file.
"""One filter for all axes, and the decoder that is shrunk towards it."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import LinearActionDecoder, Normalizer, make_koopman_inverse_dynamics
from torchrl_koap.modules.koopman.inverse_dynamics import fit_tied_axis_ridge


def test_the_filter_solves_the_ridge_equations():
    generator = torch.Generator().manual_seed(0)
    steps = torch.randn(30, 4, 2, generator=generator).double()
    action = torch.randn(30, 2, generator=generator).double()
    rows = np.concatenate([steps[..., 0].numpy(), steps[..., 1].numpy()])
    target = np.concatenate([action[:, 0].numpy(), action[:, 1].numpy()])
    weight = 0.3 * (rows**2).sum(1).mean()
    expected = np.linalg.solve(rows.T @ rows + weight * np.eye(4), rows.T @ target)
    np.testing.assert_allclose(fit_tied_axis_ridge(steps, action, penalty=0.3).numpy(), expected, rtol=1e-9)


def test_axes_that_differ_are_refused():
    with pytest.raises(ValueError, match=r"\[N, S, act\]"):
        fit_tied_axis_ridge(torch.zeros(5, 3, 2), torch.zeros(5, 3))


def test_a_ridge_around_a_prior_is_a_ridge_around_zero_on_the_rest():
    generator = torch.Generator().manual_seed(1)
    latent, action = torch.randn(40, 5, generator=generator), torch.randn(40, 2, generator=generator)
    prior, mask = torch.randn(2, 5, generator=generator), torch.ones(40, dtype=torch.bool)
    around, rest = LinearActionDecoder(5, 2), LinearActionDecoder(5, 2)
    fit = around.fit_ridge(latent, action, mask, prior=prior, bias=False)
    other = rest.fit_ridge(latent, action - latent @ prior.T, mask, bias=False)
    torch.testing.assert_close(around.linear.weight, rest.linear.weight + prior)
    assert fit.penalty == other.penalty
    around.fit_ridge(latent, action, mask, prior=prior, bias=False, penalties=(1e9,))
    torch.testing.assert_close(around.linear.weight, prior, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="prior"):
        around.fit_ridge(latent, action, mask, prior=prior.T)


def one_axis_still(num: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Windows that move along the first axis only, and actions by one filter, x_{t+3} - x_{t+2}, on both."""
    state = torch.randn(num, 16, 2, generator=torch.Generator().manual_seed(2)).cumsum(1) * 0.01
    state[..., 1] = 0.5 + 1e-6 * state[..., 1]
    return state, torch.cat([state[:, 3:] - state[:, 2:-1], torch.zeros(num, 3, 2)], 1)


def test_an_axis_without_labels_worth_the_name_is_decoded_like_the_other():
    spread = torch.randn(500, 16, 2, generator=torch.Generator().manual_seed(3)).cumsum(1) * 0.01
    answers = {}
    for axes in (None, (0, 1)):
        torch.manual_seed(0)
        model = make_koopman_inverse_dynamics(
            2,
            2,
            state_normalizer=Normalizer.fit(spread, mode="standard"),
            action_normalizer=Normalizer(torch.zeros(2), torch.full((2,), 0.01)),
        )
        model.fit_scales(spread)
        state, action = one_axis_still(200)
        mask = torch.ones(200, 16, dtype=torch.bool)
        model.fit_decoder(TensorDict({"state": state, "action": action}, [200]), mask, tied_axes=axes, bias=False)
        frame = model.num_past
        decoded = model(TensorDict({"state": spread}, [500]))["action"][:, frame, 1]
        true = spread[:, frame + 3, 1] - spread[:, frame + 2, 1]
        answers[axes] = (decoded - true).square().mean().sqrt() / true.square().mean().sqrt()
    assert answers[None] > 0.9  # nothing was learned about the second axis
    assert answers[0, 1] < 0.4


def test_tied_axes_need_fourier_latent_actions_and_one_axis_per_action_entry():
    windows = TensorDict({"state": torch.randn(8, 16, 2), "action": torch.randn(8, 16, 2)}, [8])
    mask = torch.ones(8, 16, dtype=torch.bool)
    with pytest.raises(ValueError, match="LatentActionMLP"):
        make_koopman_inverse_dynamics(2, 2, preset="released", latent_dim=8, hidden_dim=8).fit_decoder(
            windows, mask, tied_axes=(0, 1)
        )
    with pytest.raises(ValueError, match="one state column per action entry"):
        make_koopman_inverse_dynamics(2, 2).fit_decoder(windows, mask, tied_axes=(0,))
