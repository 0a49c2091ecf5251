# This source code is licensed under the MIT license found in the LICENSE file.
"""Presets: every one trains, options are checked and reach the parts."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import PRESETS, LatentActionLSTM, Normalizer, make_koopman_inverse_dynamics
from torchrl_koap.objectives import KOAPLoss


def make_batch(batch=8, d=2, num_frames=16):
    """A double integrator in normalised units: smooth paths whose differences are the actions."""
    generator = torch.Generator().manual_seed(0)
    action = 0.1 * torch.randn(batch, num_frames, d, generator=generator).cumsum(1)
    state = torch.cat([torch.zeros(batch, 1, d), action[:, :-1].cumsum(1)], 1)
    has_action = torch.rand(batch, num_frames, 1, generator=generator) < 0.5
    action = torch.where(has_action, action, torch.nan)
    return TensorDict({"state": state, "action": action, "has_action": has_action}, [batch])


def test_paper_is_the_paper():
    model = make_koopman_inverse_dynamics(2, 2, preset="paper")
    assert isinstance(model.latent_action, LatentActionLSTM) and model.reader.look_ahead == (8,)
    assert model.operator.input is None
    assert isinstance(model.lifting.encoder, torch.nn.Sequential) and not model.lifting.include_state
    assert isinstance(model.action_decoder.linear, torch.nn.Linear)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_trains(preset):
    torch.manual_seed(0)
    batch = make_batch(num_frames=17)
    model = make_koopman_inverse_dynamics(
        2,
        2,
        preset=preset,
        state_normalizer=Normalizer.fit(batch["state"]),
        action_normalizer=Normalizer.fit(batch["action"], mask=batch["has_action"]),
    )
    model.prepare(batch["state"])
    loss = KOAPLoss(model)
    optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3, weight_decay=0.01)
    first = None
    for _ in range(20):
        losses = loss(batch)
        total = sum(losses.values())
        optimizer.zero_grad()
        total.backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in loss.parameters()), preset
        optimizer.step()
        first = first or total.item()
    loss.eval()
    assert sum(loss(batch).values()) < 0.9 * first
    before = loss(batch)["loss_action"]
    fit = model.fit_labels(batch, batch["has_action"].squeeze(-1))
    assert fit["labels_used"] > 0 and loss(batch)["loss_action"] < before
    assert model(batch.select("state"))["action"].shape == (8, 17, 2)


def test_options_override_the_preset_and_reach_the_parts():
    model = make_koopman_inverse_dynamics(
        2,
        2,
        preset="paper",
        relative=True,
        look_ahead=(2, 5),
        num_past=3,
        clamped=False,
        include_state=True,
        latent_dim=10,
    )
    reader = model.reader
    assert (reader.num_past, reader.look_ahead, reader.clamped) == (3, (2, 5), False)
    assert reader.scales is not None and model.latent_action.latent_dim == 10 and model.lifting.include_state
    fourier = make_koopman_inverse_dynamics(
        2, 2, num_features=32, curvature=0.5, motion_scale=2.0, position_scale=3.0
    ).latent_action
    assert fourier.amplitude == pytest.approx((2 * 0.5 / 32) ** 0.5)
    assert (fourier.motion_scale, fourier.position_scale, fourier.phase.numel()) == (2.0, 3.0, 32)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "paperr"}, "unknown preset 'paperr'; did you mean 'paper'"),
        ({"preset": "xyz"}, "unknown preset 'xyz'; known: default, absolute, semi_supervised, paper"),
        ({"preset": None}, "unknown preset None"),
        ({"latentdim": 3}, "option .* 'latentdim'; did you mean 'latent_dim'"),
        ({"preset": "paper", "curvature": 0.1}, "option .* preset 'paper': 'curvature'"),
    ],
)
def test_unknown_names_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_koopman_inverse_dynamics(2, 2, **options)
