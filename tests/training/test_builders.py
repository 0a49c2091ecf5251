# This source code is licensed under the MIT license found in the LICENSE file.
"""From plain options to data, planners and controllers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tiny_runs import demonstration

from torchrl_koap.data import LabelBudget, save_ted
from torchrl_koap.envs.registry import make_env_of, mode_index_of
from torchrl_koap.keys import validate
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.tasks import get_task
from torchrl_koap.training.builders import build_controller
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.diffusion_builders import DENOISERS, build_planner
from torchrl_koap.training.methods import METHODS
from torchrl_koap.training.resolved import resolve

TASK = get_task("avoiding")
PLANNER = {
    "denoiser": "unet",
    "channels": [8, 16],
    "history": 2,
    "horizon": 14,
    "relative": False,
    "width": 48,
}


@pytest.fixture(scope="module")
def data(demonstrations):
    return load_demonstrations(str(demonstrations), TASK)


def test_raw_folders_become_states_and_actions(data):
    validate(data)
    commanded, measured = demonstration(2, 32)
    third = data[data["episode"] == 2]
    assert len(third) == 31
    np.testing.assert_allclose(third["state"].numpy(), measured[:-1], atol=1e-7)
    np.testing.assert_allclose(third["action"].numpy(), np.diff(commanded, axis=0), atol=1e-9)
    assert data["has_action"].all()


def test_recorded_folders_give_the_same(tmp_path, data):
    save_ted(data, tmp_path / "ted", TASK)
    again = load_demonstrations(str(tmp_path), TASK)
    for key in ("state", "action", "episode", "observation"):
        assert torch.equal(again[key], data[key])
    again["action"][0] = 7.0  # in memory: the file stays as it is
    assert torch.equal(load_demonstrations(str(tmp_path), TASK)["action"], data["action"])


def test_scripted_demonstrations_are_recorded():
    seen = []
    data = load_demonstrations("scripted", TASK, episodes=2, seed=3, progress=lambda *done: seen.append(done))
    assert data["episode"].unique().tolist() == [0, 1] and seen[-1] == (2, 2)
    assert torch.equal(data["state"], data["observation"][:, [2, 3]])


def test_missing_and_empty_folders_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="'nowhere' is no folder"):
        load_demonstrations("nowhere", TASK)
    with pytest.raises(FileNotFoundError, match=f"no demonstrations .* in {tmp_path}"):
        load_demonstrations(str(tmp_path), TASK)


@pytest.mark.parametrize("denoiser", DENOISERS)
@pytest.mark.parametrize("relative", [True, False])
def test_every_denoiser_plans(denoiser, relative):
    unfit = "width" if denoiser == "unet" else "channels"
    options = {name: value for name, value in PLANNER.items() if name != unfit}
    planner = build_planner(options | {"denoiser": denoiser, "relative": relative}, 2)
    assert planner.sample(torch.zeros(3, 2, 2)).shape == (3, 14, 2)
    assert (planner.solver, planner.num_steps, planner.clip, planner.relative) == ("dpm++2m", 10, 1.2, relative)
    assert planner.schedule.prediction == "sample"


def test_unknown_and_unfit_planner_options_are_explained():
    with pytest.raises(ValueError, match="unknown denoiser 'unnet'; did you mean 'unet'"):
        build_planner(PLANNER | {"denoiser": "unnet"}, 2)
    with pytest.raises(ValueError, match="denoiser 'unet' has no width to choose, it has channels"):
        build_planner(PLANNER, 2)
    mlp = build_planner(PLANNER | {"denoiser": "mlp"}, 2).denoiser
    assert mlp.first.out_features == 48 and len(mlp.layers) == 4
    assert mlp.encoder.frequencies.tolist() == pytest.approx([torch.pi])


@pytest.mark.parametrize(
    ("preset", "method"),
    [
        (preset, name)
        for name, method in METHODS.items()
        if method.has_planner and not method.fit
        for preset in method.presets
    ],
)
def test_every_controller_acts_and_takes_over_weights(method, preset, data):
    labelled, _ = LabelBudget(count=2).apply(data)
    options = {"method": method, "preset": preset}
    torch.manual_seed(0)
    controller = build_controller(options, 2, 2, labelled).eval()
    restored = build_controller(options, 2, 2).eval()
    restored.load_state_dict(controller.state_dict())
    states = data["state"][:32].reshape(2, 16, 2)
    expected = controller(TensorDict({"state": states}, [2]))["action"]
    assert expected.shape == (2, 16, 2)
    torch.testing.assert_close(restored(TensorDict({"state": states}, [2]))["action"], expected, rtol=0, atol=0)


def test_statistics_are_those_of_all_states_and_of_the_labelled_actions(data):
    labelled, _ = LabelBudget(count=2).apply(data)
    shown = data["action"][labelled["has_action"].squeeze(-1)]
    default = build_controller({"method": "koap", "preset": "default"}, 2, 2, labelled)
    torch.testing.assert_close(default.action_normalizer.scale, shown.square().mean(0).sqrt())
    assert (default.action_normalizer.offset == 0).all()
    torch.testing.assert_close(default.state_normalizer.offset, data["state"].mean(0))
    paper = build_controller({"method": "dd", "preset": "paper"}, 2, 2, labelled)
    torch.testing.assert_close(paper.action_normalizer.inverse(torch.ones(1, 2))[0], shown.amax(0))
    torch.testing.assert_close(paper.state_normalizer.inverse(-torch.ones(1, 2))[0], data["state"].amin(0))


def test_unknown_controllers_and_tasks_suggest_the_nearest():
    with pytest.raises(ValueError, match="unknown method 'kaop'; did you mean 'koap'"):
        build_controller({"method": "kaop", "preset": "default"}, 2, 2)
    with pytest.raises(ValueError, match="unknown preset 'papper'; did you mean 'paper'"):
        build_controller({"method": "koap", "preset": "papper"}, 2, 2)


def test_environments_and_modes_of_a_task():
    env = make_env_of(TASK, num_threads=2)(3)
    assert env.batch_size == (3,)
    env.close()
    flags = torch.tensor([[0, 1, 0, 0, 1, 0, 0, 0, 1], [0] * 9], dtype=torch.bool)
    assert mode_index_of(TASK)(flags).tolist() == [23, -1]


def test_absolute_actions_are_centred_and_read_off_the_present_frame():
    entry = resolve(TrainConfig(out=Path("run"), task="scooping")).controller
    assert entry["preset"] == "absolute"
    assert resolve(TrainConfig(out=Path("run"), task="stacking")).controller["preset"] == "default"
    state, action = torch.randn(60, 6) * torch.arange(1.0, 7.0), torch.randn(60, 2) + 5
    labelled = TensorDict({"state": state, "action": action, "has_action": torch.ones(60, 1, dtype=torch.bool)}, [60])
    controller = build_controller(entry, 6, 2, labelled)
    assert controller.latent_action.position_weight > 0 and (controller.action_normalizer.offset > 4).all()
    assert controller.state_normalizer.scale.unique().numel() == 1
    assert build_controller(entry | {"method": "linear_steps"}, 6, 2, labelled).latent_action.position_weight > 0
    plain = build_controller({**entry, "preset": "default"}, 6, 2, labelled)
    assert plain.latent_action.position_weight == 0 and not plain.action_normalizer.offset.any()
