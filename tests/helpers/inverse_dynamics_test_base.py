# This source code is licensed under the MIT license found in the LICENSE file.
"""Base class of tests for controllers: ``class TestMine(InverseDynamicsTestBase)`` inherits the tests.

A subclass builds its network and sets the frames that an action may read and the frames with full context.
"""

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import Normalizer

T = 9
STATE = {"offset": torch.tensor([0.1, -0.2, 0.0]), "scale": torch.tensor([2.0, 1.0, 3.0])}
ACTION = {"offset": torch.tensor([0.3, 0.0]), "scale": torch.tensor([0.5, 2.0])}
KEYS = {"state": "state", "action": "action", "has_action": "has_action", "padded": "padded"}


def normalizers():
    return {"state_normalizer": Normalizer(3, **STATE), "action_normalizer": Normalizer(2, **ACTION)}


def partly_labelled(*batch, share=0.5, spread=1.0):
    """Returns windows in which some frames have labels and some are padding."""
    generator = torch.Generator().manual_seed(4)
    has_action = torch.rand(*batch, T, 1, generator=generator) < share
    action = torch.where(has_action, torch.randn(*batch, T, 2, generator=generator), torch.nan)
    padded = torch.zeros(*batch, T, dtype=torch.bool)
    padded[..., :3] = torch.rand(*batch, 1, generator=generator) < 0.4
    state = spread * torch.randn(*batch, T, 3, generator=generator)
    return TensorDict({"state": state, "action": action, "has_action": has_action, "padded": padded}, batch)


def recorded(batch, span):
    padded = batch["padded"]
    return ~(padded[..., span.start : span.stop] | padded[..., span.start + 1 : span.stop + 1])


def reached(network, loss):
    network.zero_grad()
    loss.backward(retain_graph=True)
    named = [(name, value.grad) for name, value in network.named_parameters() if value.grad is not None]
    return {name.split(".")[0] for name, gradient in named if gradient.any()}


class InverseDynamicsTestBase:
    """Tests of a controller for three state columns and two action columns; windows have nine frames."""

    reads: tuple = (-2, -1, 0, 2, 3)  # offsets of the frames that an action may read
    frames = range(2, 6)  # valid frames
    latent = True  # whether it writes latent actions
    vectorized = True  # whether torch.vmap supports all its operations

    def make_network(self, seed: int = 0, **options):
        """Returns the network with the normalisers above; equal seeds give equal networks."""
        raise NotImplementedError

    def fitted(self, network):
        """Prepares the network for predictions, such as its scales; returns it."""
        network.prepare(partly_labelled(20)["state"].to(network.state_normalizer.scale))
        return network

    def test_an_action_depends_on_the_frames_it_may_read_and_no_others(self):
        network, state = self.fitted(self.make_network()), torch.randn(1, T, 3, requires_grad=True)
        action = network(TensorDict({"state": state}, [1]))["action"]
        for t in range(T):
            (gradient,) = torch.autograd.grad(action[0, t].sum(), state, retain_graph=True)
            read = {min(max(t + offset, 0), T - 1) for offset in self.reads}
            assert set(gradient[0].abs().sum(-1).nonzero().flatten().tolist()) == read
        assert network.valid_frames(T) == self.frames and network.num_past == -min(self.reads)
        shortest = network.num_past + 1 + max(self.reads)
        assert network.num_window_frames == shortest
        with pytest.raises(ValueError, match=f"at least {shortest} frames are needed"):
            network.valid_frames(shortest - 1)

    def test_an_ensemble_under_vmap_acts_as_its_members(self):
        if not self.vectorized:
            return
        first, _ = members = [self.fitted(self.make_network(seed)) for seed in (0, 1)]
        windows = partly_labelled(3).select("state")

        def act(weights):
            with weights.to_module(first):
                return first(windows.copy())["action"]

        actions = torch.vmap(act)(TensorDict.from_modules(*members))
        torch.testing.assert_close(actions, torch.stack([member(windows.copy())["action"] for member in members]))

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_batch_dimensions_types_keys_units_and_state_dict(self, dtype):
        network = self.fitted(self.make_network().to(dtype))
        network.set_keys(state=("in", "x"))
        state = torch.randn(2, 4, T, 3, dtype=dtype)
        written = network(TensorDict({"in": {"x": state}}, [2, 4]))
        action = written["action"]
        assert action.shape == (2, 4, T, 2) and action.dtype == dtype
        assert list(network.out_keys) == (["latent_action", "action"] if self.latent else ["action"])
        predicted = network.predict(state)
        torch.testing.assert_close(action, predicted * ACTION["scale"].to(dtype) + ACTION["offset"].to(dtype))
        torch.testing.assert_close(network.predict(state, range(2, 5)), predicted[..., 2:5, :])
        if self.latent:
            torch.testing.assert_close(predicted, network.decode(written["latent_action"]))
            torch.testing.assert_close(network.infer(state), written["latent_action"])
        network.set_keys(state="s", action=("out", "a"))
        assert (network.in_key, network.out_key) == ("s", ("out", "a"))
        torch.testing.assert_close(network(TensorDict({"s": state[1, 3]}, []))["out", "a"], action[1, 3])
        assert network(TensorDict({"s": state[:0]}, [0, 4]))["out", "a"].shape == (0, 4, T, 2)
        other = self.make_network(seed=1).to(dtype)
        other.load_state_dict(network.state_dict())
        assert torch.equal(other(TensorDict({"state": state}, [2, 4]))["action"], action)

    def test_a_missing_entry_is_named(self):
        network = self.make_network()
        network.set_keys(state=("in", "x"))
        with pytest.raises(KeyError, match=r"reads \('in', 'x'\); there are .*'y'.*; rename with set_keys\(state="):
            network(TensorDict({"y": torch.randn(2, T, 3)}, [2]))
        if any(True for _ in network.parameters()):
            with pytest.raises(ValueError, match="is torch.float64, .* torch.float32: cast one of them"):
                network(TensorDict({"in": {"x": torch.randn(2, T, 3).double()}}, [2]))
