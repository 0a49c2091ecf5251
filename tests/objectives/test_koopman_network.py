# This source code is licensed under the MIT license found in the LICENSE file.
"""The Koopman losses and the network they train: keys, modes, what is fitted besides, CUDA."""

from __future__ import annotations

import pytest
import torch
from small_koopman import HISTORY, LOSSES, NETWORKS, K, T, make_batch, make_network
from tensordict import TensorDict

from torchrl_koap.objectives import KOAPLoss, KoopmanReconstructionLoss


def test_keys_of_the_network_are_taken_over_and_renaming_reaches_it():
    network = make_network()
    network.set_keys(state="window", action=("robot", "velocity"))
    loss, batch = KOAPLoss(network), make_batch(3)
    assert loss.in_keys == ["window", ("robot", "velocity"), "has_action"]
    expected = KOAPLoss(make_network())(batch)
    renamed = batch.rename_key_("state", "window").rename_key_("action", ("robot", "velocity"))
    for key, value in loss(renamed).items():
        assert torch.equal(value, expected[key])
    loss.set_keys(state="x", action="a", has_action="labelled")
    assert network.in_keys == ["x"] and network.out_keys[-1] == "a"
    assert network(TensorDict({"x": renamed["window"]}, [3]))["a"].shape == (3, T, 2)
    loss.set_keys(state=None)
    assert network.in_keys == ["state"] and network.in_key == "state"


@pytest.mark.parametrize("entry", ["has_action", "padded"])
@pytest.mark.parametrize("bad", [torch.ones(3, T - 1, 1, dtype=torch.bool), torch.ones(3, T, 1)])
def test_a_mask_of_another_shape_or_type_is_refused(entry, bad):
    with pytest.raises(ValueError, match=f"'{entry}' must be bool"):
        KOAPLoss(make_network())(TensorDict({**make_batch(3), entry: bad}, [3]))


def test_a_window_too_short_is_explained():
    batch = make_batch(3, num_frames=HISTORY + K)
    message = f"a window of {HISTORY + K} frames is too short .* at least {HISTORY + K + 1} frames are needed"
    for loss_class in LOSSES[1:]:
        with pytest.raises(ValueError, match=message):
            loss_class(make_network())(batch)
    assert KoopmanReconstructionLoss(make_network())(batch)["loss_reconstruction"] > 0
    assert KOAPLoss(make_network())(make_batch(3, num_frames=HISTORY + K + 1))["loss_koopman"] > 0


def test_eval_switches_dropout_off():
    loss, batch = KOAPLoss(make_network(dropout=0.5)), make_batch(3)
    assert loss(batch)["loss_koopman"] != loss(batch)["loss_koopman"]
    loss.eval()
    assert loss(batch)["loss_koopman"] == loss(batch)["loss_koopman"]
    loss.train()
    assert loss(batch)["loss_koopman"] != loss(batch)["loss_koopman"]


def test_training_moves_the_network_that_was_handed_in_and_its_inference_path():
    """The sequence and the attributes hold the same parts: what is trained through one is used by the other."""
    network, batch = make_network("fourier"), make_batch(8)
    before = network(batch.select("state"))["action"].detach()
    loss = KOAPLoss(network)
    assert {id(p) for p in loss.parameters()} == {id(p) for p in network.parameters()}
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    sum(loss(batch).values()).backward()
    optimizer.step()
    after = network(batch.select("state"))["action"]
    assert not torch.allclose(after, before)
    torch.testing.assert_close(after, network.decode(network.infer(batch["state"])))


def test_what_is_fitted_after_the_loss_was_built_reaches_it():
    network, batch = make_network("fourier"), make_batch(64)
    loss = KOAPLoss(network)
    before = loss(batch)
    network.fit_scales(batch["state"])
    scaled = loss(batch)
    assert scaled["loss_koopman"] != before["loss_koopman"]
    network.fit_decoder(batch, batch["has_action"].squeeze(-1))
    assert loss(batch)["loss_action"] < 0.95 * scaled["loss_action"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("kind", NETWORKS)
def test_cuda_equals_cpu(kind):
    batch = make_batch(8)
    expected = KOAPLoss(make_network(kind))(batch)
    network = make_network(kind).cuda()
    for key, value in KOAPLoss(network)(batch.cuda()).items():
        assert value.device.type == "cuda"
        torch.testing.assert_close(value.cpu(), expected[key], rtol=1e-3, atol=1e-5)
    on_cpu = make_network(kind)
    errors = on_cpu.fit_decoder(batch, batch["has_action"].squeeze(-1)).errors
    batch = batch.cuda()
    fit = network.fit_decoder(batch, batch["has_action"].squeeze(-1), groups=torch.arange(8, device="cuda") // 2)
    assert fit.noise_variance.device.type == "cuda" and fit.errors.keys() == errors.keys()
    fit = network.fit_decoder(batch, batch["has_action"].squeeze(-1))
    assert list(fit.errors.values()) == pytest.approx(list(errors.values()), rel=1e-2)
