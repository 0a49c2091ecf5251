# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the Koopman losses: plain loops, masks, hidden labels, and the tests of all losses."""

import pytest
import torch
from inverse_dynamics_test_base import KEYS, T, normalizers, partly_labelled, recorded
from loss_test_base import LossTestBase
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from torchrl_koap.modules import (
    KoopmanInverseDynamics,
    KoopmanLifting,
    KoopmanOperator,
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LinearActionDecoder,
)
from torchrl_koap.objectives import KOAPLoss, KoopmanDynamicsLoss, KoopmanReconstructionLoss, LatentActionLoss

K, HISTORY = 3, 1
LOSSES = (KoopmanReconstructionLoss, KoopmanDynamicsLoss, LatentActionLoss, KOAPLoss)
NETWORKS = ("mlp", "lstm", "fourier")


def make_network(kind="mlp", *, clamped=False, seed=0):
    torch.manual_seed(seed)
    frames = {"num_past": HISTORY, "look_ahead": K, "clamped": clamped}
    if kind == "mlp":
        latent_action = LatentActionMLP(3, 4, hidden_dims=(16,), **frames)
    elif kind == "lstm":
        latent_action = LatentActionLSTM(3, 4, hidden_dim=8, **frames)
    else:
        latent_action = LatentActionFourier(3, 16, **frames)
    operator = KoopmanOperator(4, input_dim=latent_action.latent_dim if kind == "fourier" else None)
    if kind == "fourier":
        torch.nn.init.normal_(operator.input, std=0.1)
    return KoopmanInverseDynamics(
        latent_action,
        LinearActionDecoder(latent_action.latent_dim, 2),
        lifting=KoopmanLifting(3, 4, hidden_dims=(16,), include_state=kind == "fourier"),
        operator=operator,
        **normalizers(),
    )


def make_batch(*batch, share=0.5):
    return partly_labelled(*batch, share=share).exclude("padded")


def span(clamped):
    return range(HISTORY, T - 2 if clamped else T - K)


class TestKOAP(LossTestBase):
    default_keys = KEYS
    in_names = ("state", "action", "has_action")
    out_keys = ("loss_reconstruction", "loss_koopman", "loss_action")
    coefficients = {"koopman_coeff": "loss_koopman", "action_coeff": "loss_action"}
    learning_rate = 1e-2

    def make_loss(self, seed=0, **options):
        return KOAPLoss(make_network("fourier", seed=seed), **options)

    make_batch = staticmethod(partly_labelled)

    def counted(self, batch, key, elements):
        if key == "loss_reconstruction":
            return elements.numel()
        count = recorded(batch, span(False))
        if key == "loss_action":
            count &= batch["has_action"][..., span(False).start : span(False).stop, 0]
        assert (elements[~count] == 0).all() and (elements[count] > 0).all()
        return count.sum()


def test_compiled_equals_eager_for_the_lstm():
    torch._dynamo.reset()
    loss, batch = KOAPLoss(make_network("lstm")), make_batch(3)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(batch)
    for key, value in loss(batch).items():
        torch.testing.assert_close(compiled[key], value)


# values


def in_plain_loops(network, batch, clamped):
    """All three losses, element by element, from the weights and the definition."""
    g, decoder, f = network.lifting, network.action_decoder.linear, network.latent_action
    offset, scale = network.state_normalizer.offset, network.state_normalizer.scale
    a_offset, a_scale = network.action_normalizer.offset, network.action_normalizer.scale
    reconstruction, dynamics, action = [], [], []
    for window in range(len(batch)):
        x = [(row - offset) / scale for row in batch["state"][window]]
        z = [g.encoder(row) for row in x]
        if g.include_state:
            z = [torch.cat([row, lifted]) for row, lifted in zip(x, z, strict=True)]
        reconstruction += [((g.decoder(z[t]) - x[t]) ** 2).mean() for t in range(T)]
        for t in span(clamped):
            read = [x[t - 1], x[t], x[min(t + K, T - 1)]]
            if isinstance(f, LatentActionMLP):
                u = f.network(torch.cat(read))
            elif isinstance(f, LatentActionLSTM):
                lstm = torch.nn.LSTM(3, 8, batch_first=True)
                weights = dict(f.lstm.named_parameters())
                u = f.readout(torch.func.functional_call(lstm, weights, torch.stack(read)[None])[0][0, -1])
            else:
                motion = torch.cat([x[t] - read[0], read[2] - x[t]]) / 6**0.5
                phase = torch.cat([motion, x[t] / 4]) @ f.frequency + f.phase
                u = torch.cat([motion, (2 * 0.1 / 16) ** 0.5 * torch.cos(phase)])
            step = u if network.operator.input is None else network.operator.input @ u
            predicted = network.operator.weight @ z[t] + step
            dynamics.append(((predicted - z[t + 1]) ** 2).mean())
            if batch["has_action"][window, t]:
                target = (batch["action"][window, t] - a_offset) / a_scale
                action.append(((decoder.weight @ u + decoder.bias - target) ** 2).mean())
    return {
        "loss_reconstruction": torch.stack(reconstruction),
        "loss_koopman": torch.stack(dynamics),
        "loss_action": torch.stack(action),
    }


@pytest.mark.parametrize("clamped", [False, True])
@pytest.mark.parametrize("kind", NETWORKS)
def test_values_and_gradients_in_plain_loops(kind, clamped):
    """Gradients also of the target g(x_{t+1}), which is not detached, as in KOAP's first public code."""
    network, batch = make_network(kind, clamped=clamped), make_batch(4)
    parameters, expected = dict(network.named_parameters()), in_plain_loops(network, batch, clamped)
    losses = KOAPLoss(network, koopman_coeff=0.5, action_coeff=3.0)(batch)
    for key, factor in (("loss_reconstruction", 1.0), ("loss_koopman", 0.5), ("loss_action", 3.0)):
        wanted = factor * expected[key].mean()
        torch.testing.assert_close(losses[key], wanted)
        gradients = (
            torch.autograd.grad(value, parameters.values(), retain_graph=True, allow_unused=True)
            for value in (losses[key], wanted)
        )
        for name, one, other in zip(parameters, *gradients, strict=True):
            zeros = torch.zeros_like(parameters[name])
            one, other = (zeros if gradient is None else gradient for gradient in (one, other))
            assert torch.allclose(one, other, rtol=1e-3, atol=1e-5), (key, name)
    elements = KOAPLoss(network, reduction="none")(batch)
    torch.testing.assert_close(elements["loss_koopman"].flatten(), expected["loss_koopman"])
    assert elements["loss_koopman"].shape == elements["loss_action"].shape == (4, len(span(clamped)))
    labelled = batch["has_action"][:, span(clamped).start : span(clamped).stop, 0]
    torch.testing.assert_close(elements["loss_action"][labelled], expected["loss_action"])
    assert (elements["loss_action"][~labelled] == 0).all()


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
@pytest.mark.parametrize("loss_class", LOSSES[:3])
def test_single_losses_are_the_terms_of_the_sum_and_read_no_more(loss_class, reduction):
    batch = make_batch(4)
    single, together = loss_class(make_network(), reduction=reduction), KOAPLoss(make_network(), reduction=reduction)
    labels = ["action", "has_action"] if loss_class is LatentActionLoss else []
    assert single.in_keys == ["state", *labels]
    found = single(batch.select(*single.in_keys))
    assert list(found.keys()) == single.out_keys and len(single.out_keys) == 1
    for key, value in found.items():
        assert torch.equal(value, together(batch)[key])
        together.select_out_keys(key)
        assert set(together(batch).keys()) == {key} and torch.equal(together(batch)[key], value)
    with pytest.raises(KeyError, match="state.*there are"):
        single(batch.exclude("state"))


def test_a_subclass_adds_errors_that_count_where_those_of_the_dynamics_do():
    class Bounded(KOAPLoss):
        out_keys = [*TestKOAP.out_keys, "loss_norm", "loss_again"]

        def further_errors(self, lifted, latent):
            frames = self.network.valid_frames(lifted.shape[-2])
            now, after = lifted[..., frames.start : frames.stop, :], lifted[..., frames.start + 1 : frames.stop + 1, :]
            again = (self.network.predict_next(now, latent) - after).square().mean(-1)
            return {"loss_norm": torch.linalg.matrix_norm(self.network.operator.weight, 2), "loss_again": again}

    network, batch = make_network(), partly_labelled(4)  # some frames are padded
    found, norm = Bounded(network)(batch), torch.linalg.matrix_norm(network.operator.weight, 2)
    assert set(found.keys()) == {*TestKOAP.out_keys, "loss_norm", "loss_again"}
    torch.testing.assert_close(found["loss_again"], found["loss_koopman"])
    torch.testing.assert_close(found["loss_norm"], norm)
    found["loss_norm"].backward()
    assert network.operator.weight.grad.abs().sum() > 0


# labels


def test_a_labelled_action_that_is_nan_gives_a_nan_loss():
    batch = make_batch(4, share=1.0)
    batch["action"][0, 2] = torch.nan
    assert LatentActionLoss(make_network())(batch)["loss_action"].isnan()


# the network


def test_a_flat_batch_of_several_trajectories_is_not_taken_for_one_window():
    network, batch = make_network(), make_batch(2)
    batch["episode"] = torch.tensor([[0] * T, [1] * T])
    flat = TensorDict({key: value.flatten(0, 1) for key, value in batch.items()}, [2 * T])
    done = torch.zeros(2, T, dtype=torch.bool)
    done[:, -1] = True  # SliceSampler marks the last step of every slice
    ended = flat.exclude("episode").set("next", {"done": done.reshape(-1, 1)})
    for module in (KOAPLoss(network), LatentActionLoss(network), network, network.latent_action):
        with pytest.raises(ValueError, match=r"several trajectories \('episode'\); reshape a flat batch"):
            module(flat.clone())
        with pytest.raises(ValueError, match=r"several trajectories .*'done'"):
            module(ended.clone())
        module(batch.clone()), module(batch[0].clone()), module(ended[:T].clone())
    alone = batch[0].exclude("episode").auto_batch_size_(0)
    network(alone.set("next", {"done": torch.zeros(1, dtype=torch.bool)}))  # one flag for the whole window
    repeated = torch.arange(T).clamp_max(T - 3)
    network(ended[T:][repeated].set("next", {"done": (repeated == T - 3).unsqueeze(-1)}))  # padded at its end
    with pytest.raises(ValueError, match=r"several trajectories"):
        network.fit_labels(flat, flat["has_action"])


def test_coefficients_may_be_given_as_whole_numbers_and_changed():
    loss = KOAPLoss(make_network(), action_coeff=1)
    loss.action_coeff = 0.5
    assert loss.action_coeff == 0.5


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
    elsewhere = TensorDict({"x": renamed["window"], "a": renamed["robot", "velocity"]}, [3])
    assert torch.equal(loss(elsewhere.set("labelled", batch["has_action"]))["loss_action"], expected["loss_action"])
    loss.set_keys(state=None)
    assert network.in_keys == ["state"] and network.in_key == "state"
    network.set_keys(state="window")
    assert loss.in_keys[0] == "state" and network.in_key == "window"


def test_frames_that_a_slice_sampler_of_torchrl_appends_count_as_padded():
    sampler = SliceSampler(slice_len=T, traj_key="episode", strict_length=False, pad_output=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4 * T), sampler=sampler, batch_size=32 * T)
    steps = make_batch(4, share=0.9).set("episode", torch.arange(4)[:, None].expand(4, T)).auto_batch_size_(2)
    steps["next", "done"] = torch.zeros(4, T, 1, dtype=torch.bool)
    buffer.extend(torch.cat([row[: T - number] for number, row in enumerate(steps)]))
    torch.manual_seed(0)
    batch = buffer.sample().reshape(32, T)
    recorded = batch["collector", "mask"]
    assert 0.5 < recorded.float().mean() < 0.95
    loss, bare = KOAPLoss(make_network()), batch.exclude("collector")
    found, without = loss(batch), loss(bare)
    expected = loss(bare.set("padded", ~recorded))
    assert all(torch.equal(found[key], expected[key]) for key in loss.out_keys)
    assert (found["loss_koopman"] - without["loss_koopman"]).abs() > 1e-3
    loss.loss_mask_key = None
    assert torch.equal(loss(batch)["loss_koopman"], without["loss_koopman"])


@pytest.mark.parametrize("entry", ["has_action", "padded"])
@pytest.mark.parametrize("bad", [torch.ones(3, T - 1, 1, dtype=torch.bool), torch.ones(3, T, 1)])
def test_a_mask_of_another_shape_or_type_is_refused(entry, bad):
    with pytest.raises(ValueError, match=f"'{entry}' must be bool"):
        KOAPLoss(make_network())(TensorDict({**make_batch(3), entry: bad}, [3]))


@pytest.mark.parametrize("bad", [torch.ones(3, T - 1, 2), torch.ones(3, T + 4, 2), torch.ones(3, T)])
def test_actions_of_other_frames_are_refused(bad):
    with pytest.raises(ValueError, match=rf"'action' must have the batch and frames \[3, {T}\] .*, got \[3, "):
        KOAPLoss(make_network())(TensorDict({**make_batch(3), "action": bad}, [3]))


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
    expected = on_cpu.fit_labels(batch, batch["has_action"].squeeze(-1))
    batch = batch.cuda()
    grouped = batch.clone().set("episode", torch.arange(8, device="cuda") // 2)
    found = network.fit_labels(grouped, batch["has_action"].squeeze(-1))
    assert network.action_decoder.linear.weight.is_cuda and found["labels_used"] == expected["labels_used"]
    found = network.fit_labels(batch, batch["has_action"].squeeze(-1))
    assert found["held_out_error"] == pytest.approx(expected["held_out_error"], rel=1e-2)
