# This source code is licensed under the MIT license found in the LICENSE file.
"""KOAP with nonlinear maps and its loss: plain loops, the successor that is not read, hidden labels, learning."""

from __future__ import annotations

import pytest
import torch
from loss_test_base import LossTestBase
from tensordict import TensorDict

from torchrl_koap.modules import LatentActionMLP, NonlinearInverseDynamics, Normalizer
from torchrl_koap.objectives import NonlinearLoss

T, HISTORY, LOOK_AHEAD = 9, 2, (2, 3)
SPAN = range(2, 6)


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    return NonlinearInverseDynamics(
        3,
        2,
        latent_dim=6,
        hidden_dims=(16,),
        lifting_dims=(12,),
        num_past=HISTORY,
        look_ahead=LOOK_AHEAD,
        state_normalizer=Normalizer(torch.tensor([0.1, -0.2, 0.0]), torch.tensor([2.0, 1.0, 3.0])),
        action_normalizer=Normalizer(torch.tensor([0.3, 0.0]), torch.tensor([0.5, 2.0])),
        **options,
    )


def make_batch(*batch, share=0.5):
    generator = torch.Generator().manual_seed(4)
    has_action = torch.rand(*batch, T, 1, generator=generator) < share
    action = torch.where(has_action, torch.randn(*batch, T, 2, generator=generator), torch.nan)
    padded = torch.zeros(*batch, T, dtype=torch.bool)
    padded[..., :3] = torch.rand(*batch, 1, generator=generator) < 0.4
    state = torch.randn(*batch, T, 3, generator=generator)
    return TensorDict({"state": state, "action": action, "has_action": has_action, "padded": padded}, batch)


def recorded(batch):
    frames = slice(SPAN.start, SPAN.stop)
    return ~(batch["padded"][..., frames] | batch["padded"][..., SPAN.start + 1 : SPAN.stop + 1])


class TestNonlinearLoss(LossTestBase):
    default_keys = {"state": "state", "action": "action", "has_action": "has_action", "padded": "padded"}
    in_names = ("state", "action", "has_action")
    out_keys = ("loss_reconstruction", "loss_dynamics", "loss_action")
    coefficients = {"dynamics_coeff": "loss_dynamics", "action_coeff": "loss_action"}
    learning_rate = 1e-2

    def make_loss(self, seed=0, **options):
        return NonlinearLoss(make_network(seed), **options)

    def make_batch(self, *batch):
        return make_batch(*batch)

    def counted(self, batch, key, elements):
        if key == "loss_reconstruction":
            return elements.numel()
        counts = recorded(batch)
        if key == "loss_action":
            counts = counts & batch["has_action"][..., SPAN.start : SPAN.stop, 0]
        assert (elements[~counts] == 0).all() and (elements[counts] > 0).all()
        return int(counts.sum())


# values


def in_plain_loops(network, batch):
    """The three terms from the definition."""
    offset, scale = network.state_normalizer.offset, network.state_normalizer.scale
    scales = network.reader.scales
    terms = {"loss_reconstruction": [], "loss_dynamics": [], "loss_action": []}
    for window in range(len(batch)):
        x = (batch["state"][window] - offset) / scale
        z = [network.lifting.encoder(row) for row in x]
        terms["loss_reconstruction"] += [((network.lifting.decoder(z[t]) - x[t]) ** 2).mean() for t in range(T)]
        for t in SPAN:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            read = [x[t - 1] - x[t - 2], x[t] - x[t - 1], x[t], x[t + 2] - x[t], x[t + 3] - x[t + 2]]
            u = network.reader.network((torch.stack(read) / scales).flatten())
            terms["loss_dynamics"].append(((network.dynamics(torch.cat([z[t], u])) - z[t + 1]) ** 2).mean())
            if batch["has_action"][window, t]:
                target = (batch["action"][window, t] - torch.tensor([0.3, 0.0])) / torch.tensor([0.5, 2.0])
                terms["loss_action"].append(((network.action_decoder(u) - target) ** 2).mean())
    return {key: torch.stack(values).mean() for key, values in terms.items()}


def test_values_and_gradients_in_plain_loops():
    network, batch = make_network(), make_batch(6)
    network.fit_scales(batch["state"])
    assert (network.reader.scales != 1).any()
    expected, losses = in_plain_loops(network, batch), NonlinearLoss(network)(batch)
    parameters = list(network.parameters())
    for key, value in losses.items():
        torch.testing.assert_close(value, expected[key])
        wanted = torch.autograd.grad(expected[key], parameters, retain_graph=True, allow_unused=True)
        actual = torch.autograd.grad(value, parameters, retain_graph=True, allow_unused=True)
        for left, right in zip(actual, wanted, strict=True):
            assert (left is None or (left == 0).all()) if right is None else torch.allclose(left, right, atol=1e-6)


def test_one_term_trains_only_what_it_should():
    network, batch = make_network(), make_batch(6)
    reached = {}
    for key, value in NonlinearLoss(network)(batch).items():
        network.zero_grad()
        value.backward(retain_graph=True)
        names = {name.split(".")[0] for name, p in network.named_parameters() if p.grad is not None and p.grad.any()}
        reached[key] = names
    assert reached == {
        "loss_reconstruction": {"lifting"},
        "loss_dynamics": {"lifting", "reader", "dynamics"},
        "loss_action": {"reader", "action_decoder"},
    }


def test_its_latent_actions_are_those_of_the_koopman_models_network():
    network, state = make_network(), torch.randn(4, T, 3)
    plain = LatentActionMLP(3, 6, hidden_dims=(16,), num_past=HISTORY, look_ahead=LOOK_AHEAD, relative=True)
    plain.load_state_dict(network.reader.state_dict())
    expected = plain(TensorDict({"state": network.normalize_state(state)}, [4]))["latent_action"]
    assert torch.equal(network(TensorDict({"state": state}, [4]))["latent_action"], expected)


def test_the_successor_reaches_no_latent_action():
    network, state = make_network(), torch.randn(1, T, 3, requires_grad=True)
    action = network(TensorDict({"state": state}, [1]))["action"]
    for t in SPAN:
        (gradient,) = torch.autograd.grad(action[0, t].sum(), state, retain_graph=True)
        assert gradient[0].abs().sum(-1).nonzero().flatten().tolist() == [t - 2, t - 1, t, t + 2, t + 3]
    assert network.span(T) == SPAN and network.num_window_frames == 6 and network.num_past == 2
    with pytest.raises(ValueError, match="look_ahead offsets must be >= 2"):
        NonlinearInverseDynamics(3, 2, look_ahead=(1, 2))
    with pytest.raises(ValueError, match="at least 6 frames are needed"):
        NonlinearLoss(network)(make_batch(2).exclude("padded").apply(lambda value: value[:, :5]))


# labels


@pytest.mark.parametrize("poison", [1e30, torch.inf, torch.nan])
def test_hidden_actions_reach_neither_value_nor_gradient(poison):
    batch, results = make_batch(6), []
    for value in (0.0, poison):
        network, data = make_network(), batch.clone()
        data["action"] = torch.where(batch["has_action"], batch["action"], value)
        losses = NonlinearLoss(network)(data)
        sum(losses.values()).backward()
        results.append([*losses.values(), *(p.grad for p in network.parameters())])
    for left, right in zip(*results, strict=True):
        assert left.isfinite().all() and torch.equal(left, right)


def test_without_labels_loss_and_gradients_of_the_action_are_exactly_zero():
    network = make_network()
    losses = NonlinearLoss(network)(make_batch(6, share=0.0))
    assert losses["loss_action"] == 0 and losses["loss_dynamics"] > 0
    losses["loss_action"].backward()
    assert all((value.grad == 0).all() for value in network.parameters() if value.grad is not None)


# the controller


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_dimensions_types_keys_units_and_state_dict(dtype):
    network = make_network(in_key=("in", "x")).to(dtype)
    state = torch.randn(2, 4, T, 3, dtype=dtype)
    network.fit_scales(state)
    written = network(TensorDict({"in": {"x": state}}, [2, 4]))
    action, latent = written["action"], written["latent_action"]
    assert action.shape == (2, 4, T, 2) and action.dtype == dtype and latent.shape == (2, 4, T, 6)
    assert list(network.out_keys) == ["latent_action", "action"]
    scale, offset = torch.tensor([0.5, 2.0]).to(dtype), torch.tensor([0.3, 0.0]).to(dtype)
    torch.testing.assert_close(action, network.decode(latent) * scale + offset)
    network.set_keys(state="s", action=("out", "a"))
    torch.testing.assert_close(network(TensorDict({"s": state[1, 3]}, []))["out", "a"], action[1, 3])
    other = make_network(seed=1).to(dtype)
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(TensorDict({"state": state}, [2, 4]))["action"], action)


def test_it_learns_curved_actions_from_some_labels_beside_unlabelled_windows():
    """Actions that bend with the step: a = v + v^2 / 2 for paths of random constant velocity v."""
    generator = torch.Generator().manual_seed(0)
    velocity = torch.randn(1280, 1, 2, generator=generator)
    state = torch.randn(1280, 1, 2, generator=generator) + 0.1 * velocity * torch.arange(8.0)[:, None]
    action = (velocity + velocity.square() / 2).expand(-1, 8, -1).clone()
    data = TensorDict({"state": state, "action": action}, [1280])
    data["has_action"] = torch.zeros(1280, 8, 1, dtype=torch.bool)
    data["has_action"][:128] = True
    torch.manual_seed(0)
    network = NonlinearInverseDynamics(2, 2, latent_dim=8, hidden_dims=(64, 64), num_past=1, look_ahead=(2, 3))
    network.fit_scales(data["state"][:1024])
    loss = NonlinearLoss(network)
    unseen = data[1024:]
    before = loss(unseen)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(400):
        sum(loss(data[torch.randint(1024, (64,), generator=generator)]).values()).backward()
        optimizer.step()
        optimizer.zero_grad()
    after = loss(unseen)
    for key in ("loss_reconstruction", "loss_dynamics"):
        assert after[key] < 0.2 * before[key], (key, before[key], after[key])
    error = (network(unseen.select("state"))["action"] - unseen["action"])[:, 1:5].square().mean()
    assert error < 0.1, error  # the mean action has error 1.5, the best linear map of the step 0.5
