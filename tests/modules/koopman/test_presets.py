# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests presets: every weight is trained, and options are checked and passed to the parts."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import PRESETS, FourierKernel, LatentActionLSTM, Normalizer, make_koopman_inverse_dynamics
from torchrl_koap.objectives import KOAPLoss


def test_paper_is_the_paper():
    model = make_koopman_inverse_dynamics(2, 2, preset="paper")
    assert isinstance(model.latent_action, LatentActionLSTM) and model.reader.look_ahead == (8,)
    assert model.operator.input is None and model.reader.clamped and model.penalty == 0.15
    assert isinstance(model.lifting.encoder, torch.nn.Sequential) and not model.lifting.include_state
    assert isinstance(model.action_decoder.linear, torch.nn.Linear)


@pytest.mark.parametrize(("preset", "columns"), [*((name, 2) for name in PRESETS), ("semi_supervised", 24)])
def test_every_weight_of_every_preset_is_trained(preset, columns):
    torch.manual_seed(0)
    state, has_action = torch.randn(8, 17, columns).cumsum(1), torch.rand(8, 17, 1) < 0.5
    batch = TensorDict({"state": state, "action": torch.randn(8, 17, 2), "has_action": has_action}, [8])
    model = make_koopman_inverse_dynamics(columns, 2, preset=preset, state_normalizer=Normalizer.fit(state))
    model.prepare(state)
    loss = KOAPLoss(model)
    sum(loss(batch).values()).backward()
    assert all(weight.grad is not None and weight.grad.isfinite().all() for weight in loss.parameters())
    before = loss.eval()(batch)["loss_action"]
    assert model.fit_labels(batch, has_action.squeeze(-1))["labels_used"] > 0 and loss(batch)["loss_action"] < before


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
    kernels = {"one": FourierKernel(0.5, 2.0, 3.0)}
    fourier = make_koopman_inverse_dynamics(2, 2, num_features=32, kernels=kernels).latent_action
    assert fourier.kernel == pytest.approx(((2 * 0.5 / 32) ** 0.5, 2.0, 3.0))
    assert fourier.blocks == ("one",) and fourier.phase.numel() == 32
    compact = make_koopman_inverse_dynamics(9, 2, preset="semi_supervised", hidden_dim=16).lifting
    assert compact.coordinates == 2 and compact.small.encoder[0].out_features == 16  # one for each action entry


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "paperr"}, "unknown preset 'paperr'; did you mean 'paper'"),
        ({"preset": "xyz"}, "unknown preset 'xyz'; known: default, delayed, absolute, semi_supervised, scene, paper"),
        ({"preset": None}, "unknown preset None"),
        ({"latentdim": 3}, "option .* 'latentdim'; did you mean 'latent_dim'"),
        ({"normalization": {"state": "minmax"}}, "option .* preset 'default': 'normalization'"),
        ({"preset": "paper", "kernels": {}}, "option .* preset 'paper': 'kernels'"),
        ({"include_state": True}, "include_state needs latent_dim >= state_dim, got 32 < 33"),
    ],
)
def test_unknown_names_and_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_koopman_inverse_dynamics(33, 2, **options)
