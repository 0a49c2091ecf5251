# This source code is licensed under the MIT license found in the LICENSE file.
"""The auto-encoder of whole windows: what it reads, what it reconstructs, and that samples are what is decoded."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import SupervisedInverseDynamics, WindowVariationalInverseDynamics
from torchrl_koap.objectives import LatentDecoderLoss, VariationalLoss


def windows(labelled=True):
    torch.manual_seed(0)
    state = torch.randn(5, 16, 3).cumsum(1)
    mask = torch.full((5, 16, 1), labelled)
    return TensorDict({"state": state, "action": torch.randn(5, 16, 2), "has_action": mask}, [5])


def test_every_frame_knows_the_whole_window():
    model = WindowVariationalInverseDynamics(3, 2, hidden_dim=8)
    state = windows()["state"][0]
    latent = model.infer(state)
    for changed in (0, 15):
        other = state.clone()
        other[changed] += 1
        assert (model.infer(other) != latent).any(-1).all()
    assert model.span(16) == range(1, 15) and model.num_window_frames == 16 and model.num_past == 1
    assert torch.equal(model.infer(state, range(1, 15)), latent[1:15])


def test_no_window_at_all_is_read_as_none():
    """Where every trajectory has a label there is nothing to measure hidden actions on."""
    model = WindowVariationalInverseDynamics(3, 2, hidden_dim=8)
    assert model(TensorDict({"state": torch.zeros(0, 16, 3)}, [0]))["action"].shape == (0, 16, 2)


def test_states_are_reconstructed_from_the_latent_alone():
    model = WindowVariationalInverseDynamics(3, 2, hidden_dim=8)
    read = model.read(windows()["state"])
    present, target = model.split(read)
    assert present.shape[-1] == 0 and torch.equal(target, model.reader(windows()["state"]))
    assert model.reconstruct(torch.zeros(5, 16, 16), present).shape == target.shape
    loss = VariationalLoss(model)(windows())
    sum(loss.values()).backward()
    touched = {name.split(".")[0] for name, value in model.named_parameters() if value.grad is not None}
    assert touched == {"context", "encoder", "decoder"}


def test_the_action_decoder_is_fitted_to_samples_and_acts_on_the_mean():
    model = WindowVariationalInverseDynamics(3, 2, hidden_dim=8)
    loss = LatentDecoderLoss(model, samples=True)
    torch.manual_seed(1)
    first, second = (loss(windows())["loss_action"].item() for _ in range(2))
    assert first == second  # windows() seeds what is drawn
    batch = windows()
    assert loss(batch)["loss_action"].item() != loss(batch)["loss_action"].item()
    loss(batch)["loss_action"].backward()
    assert {n.split(".")[0] for n, v in model.named_parameters() if v.grad is not None} == {"action_decoder"}
    assert torch.equal(model(batch.clone())["action"], model(batch.clone())["action"])


def test_samples_need_a_network_that_has_them():
    with pytest.raises(ValueError, match="samples were asked for, but SupervisedInverseDynamics"):
        LatentDecoderLoss(SupervisedInverseDynamics(2, 2), samples=True)
