# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the construction of planners and controllers from options."""

import numpy as np
import pytest
import torch
from small_networks import controller_of
from tensordict import TensorDict
from torch import nn

from torchrl_koap import PlannerConfig, TrainConfig, Trained, fit, make_demonstrations, save_demonstrations, train
from torchrl_koap.data import LabelBudget, open_dataset
from torchrl_koap.modules import StatePlanner, TemporalUnet
from torchrl_koap.modules.planning.denoisers import EMBEDDING_DIM, ConditionEncoder, Denoiser
from torchrl_koap.tasks import get_task
from torchrl_koap.training import defaults, networks, register_network
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import METHODS
from torchrl_koap.training.networks import NETWORKS, build_planner, sizes_of

TASK = get_task("avoiding")


@pytest.fixture(scope="module")
def data(demonstrations):
    return open_dataset(demonstrations, task=TASK)[0]


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("task", ["aligning", "sorting"])
def test_every_network_plans(network, frames, task):
    task = get_task(task)
    planner = build_planner(task, PlannerConfig(network=network, width=16, octaves=2, frames=frames))
    assert planner.sample(torch.zeros(3, frames, task.state_dim)).shape == (3, 14, task.state_dim)
    assert (planner.relative, planner.history) == (task.defaults.relative, frames)
    assert sizes_of(planner) == {"network": network, "width": 16, "octaves": 2, "frames": frames}


def test_a_network_of_one_level_has_a_width():
    planner = StatePlanner(TemporalUnet(2, 4, channels=(16,)), state_dim=2)
    assert sizes_of(planner) == {"network": "unet", "width": 16, "octaves": 4, "frames": 2}


class Transformer(Denoiser):
    """A network from outside: attention over the frames."""

    def __init__(self, state_dim, condition_dim, *, width, frequencies, horizon):
        super().__init__(state_dim, condition_dim)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=width)
        self.first = nn.Linear(state_dim + width + EMBEDDING_DIM, width)
        self.last = nn.Linear(width, state_dim)
        self.place = nn.Parameter(0.1 * torch.randn(horizon, width))
        self.layer = nn.TransformerEncoderLayer(width, 2, 2 * width, dropout=0.0, batch_first=True)

    def denoise(self, x, step, condition):
        context = torch.cat([self.encoder(condition), step], -1).unsqueeze(1).expand(-1, x.shape[1], -1)
        return self.last(self.layer(self.first(torch.cat([x, context], -1)) + self.place))


def test_a_network_from_outside_is_trained_saved_and_loaded_by_its_name(tmp_path, monkeypatch):
    monkeypatch.setattr(networks, "NETWORKS", dict(NETWORKS))
    monkeypatch.setattr(defaults, "NETWORKS", networks.NETWORKS)
    register_network("transformer", Transformer, width=16, octaves=0)
    states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(4)]
    folder = save_demonstrations(tmp_path / "arm", states, [np.diff(path, axis=0) for path in states], control_hz=30)
    config = PlannerConfig(network="transformer", steps=3)
    trained = train(TrainConfig(out=tmp_path / "run", dataset=str(folder), method="linear", planner=config))
    section = trained.config.planner
    assert (section.width, section.octaves, section.batch_size) == (16, 0, 512)
    loaded = Trained.load(tmp_path / "run").planner
    assert isinstance(loaded.denoiser, Transformer)
    assert torch.equal(loaded.denoiser.place, trained.planner.denoiser.place)
    with pytest.raises(
        ValueError, match=r"another network named 'transformer' .* first `del torchrl_koap.training.NETWORKS"
    ):
        register_network("transformer", Transformer)
    with pytest.raises(ValueError, match="unknown default of a network 'widht'; did you mean 'width'"):
        register_network("other", Transformer, widht=8)
    with pytest.raises(ValueError, match="its denoiser is a Transformer: register it"):
        fit(*make_demonstrations(states, [np.diff(path, axis=0) for path in states], control_hz=30), planner=loaded)


@pytest.mark.parametrize(
    ("preset", "method"),
    [(preset, name) for name, method in METHODS.items() if method.plans for preset in method.presets],
)
def test_every_controller_takes_over_weights(method, preset, data):
    labelled, _ = LabelBudget(count=2).apply(data)
    torch.manual_seed(0)
    controller = controller_of(method, labelled, preset=preset).eval()
    if METHODS[method].fit is not None:
        METHODS[method].fit(controller, labelled, 1)
    with torch.device("meta"):  # without storage, which the weights bring
        restored = controller_of(method, preset=preset).eval()
    restored.load_state_dict(controller.state_dict(), assign=True)
    assert not any(value.is_meta for value in (*restored.parameters(), *restored.buffers()))
    state, other = controller.state_dict(), restored.state_dict()
    assert all(torch.allclose(state[name], other[name], rtol=0, atol=0, equal_nan=True) for name in state)
    if METHODS[method].fit is None:
        states = data["state"][:32].reshape(2, 16, 2)
        expected = controller(TensorDict({"state": states}, [2]))["action"]
        assert expected.shape == (2, 16, 2)
        torch.testing.assert_close(restored(TensorDict({"state": states}, [2]))["action"], expected, rtol=0, atol=0)


def test_statistics_are_those_of_all_states_and_of_the_labelled_actions(data):
    labelled, _ = LabelBudget(count=2).apply(data)
    shown = data["action"][labelled["has_action"].squeeze(-1)]
    default = controller_of("koap", labelled)
    torch.testing.assert_close(default.action_normalizer.scale, shown.square().mean(0).sqrt())
    assert (default.action_normalizer.offset == 0).all()
    torch.testing.assert_close(default.state_normalizer.offset, data["state"].mean(0))
    paper = controller_of("dd", labelled, preset="paper")
    torch.testing.assert_close(paper.action_normalizer.inverse(torch.ones(1, 2))[0], shown.amax(0))
    torch.testing.assert_close(paper.state_normalizer.inverse(-torch.ones(1, 2))[0], data["state"].amin(0))


def test_absolute_actions_are_centred_and_read_off_the_present_frame():
    task = get_task("scooping")
    state = torch.randn(60, task.state_dim) * torch.arange(1.0, task.state_dim + 1)
    labelled = TensorDict({"state": state, "action": torch.randn(60, task.action_dim) + 5}, [60])
    labelled["has_action"] = torch.ones(60, 1, dtype=torch.bool)
    preset = resolve(TrainConfig(out="run"), task).controller.preset
    assert preset == "absolute" and resolve(TrainConfig(out="run"), TASK).controller.preset == "default"
    controller = controller_of("koap", labelled, task=task, preset=preset)
    assert (controller.action_normalizer.offset > 4).all()
    assert controller.state_normalizer.scale.unique().numel() == 1
