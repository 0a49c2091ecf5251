# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's baselines and settings in training: weights of losses, revised methods, noise of PO-Sorting's data."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from tiny_runs import TINY, koap

from torchrl_koap.data import flatten_trajectories, load_ted, save_ted
from torchrl_koap.evaluation import load_run
from torchrl_koap.modules import SupervisedInverseDynamics, WindowVariationalInverseDynamics
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import get_task
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.resolved import resolve


@pytest.fixture(scope="module")
def relabel_run(demonstrations, tmp_path_factory):
    folder = tmp_path_factory.mktemp("relabel") / "run"
    assert koap("train", "--out", folder, "--dataset", demonstrations, "--method", "relabel", *TINY) == 0
    return folder


def test_relabel_is_a_decision_diffuser(relabel_run):
    trained = load_run(relabel_run)
    assert isinstance(trained.controller, SupervisedInverseDynamics) and trained.planner is not None
    assert trained.controller.reader.look_ahead == (1,) and trained.method.teacher == "dd_lookahead"
    # its action statistics are those of all steps, the teacher's included, not of the labelled ones alone
    names = load_tensors(relabel_run / "controller.safetensors")[0]
    assert any("action_normalizer" in name for name in names)


def test_runs_of_before_keep_their_method(relabel_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(relabel_run, folder, ignore=shutil.ignore_patterns(".lock"))
    config = json.loads((folder / "config.json").read_text())
    assert config["controller"].pop("revised") is True
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(Exception, match="controller.safetensors"):  # no Diffusion Policy's weights lie there
        load_run(folder)
    assert get_method("relabel").earlier == "dp_relabel" and get_method("vae").earlier == "vae_steps"


def test_the_auto_encoder_reads_the_window_that_policies_hand_it():
    resolved = resolve(TrainConfig(out="run", method="vae"))
    model = resolved.method.build(2, 2, {}, resolved.controller)
    assert isinstance(model, WindowVariationalInverseDynamics) and model.num_window_frames == 16


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("dd", {"koopman_coeff": 1.0}, "koopman_coeff was given, but no loss of method 'dd' has it"),
        ("koap", {"action_coeff": 1.0}, "action_coeff was given, but no loss of method 'koap' has it"),
        ("koap_paper", {"action_coeff": -1.0}, "action_coeff must be >= 0, got -1.0"),
    ],
)
def test_coefficients_of_no_loss_are_refused(method, options, message):
    with pytest.raises(ValueError, match=message):
        resolve(TrainConfig(out="run", method=method, **options))


def test_demonstrations_of_po_sorting_are_as_noisy_as_its_rollouts(tmp_path):
    frames = torch.linspace(0.1, 0.5, 200)[:, None].expand(200, 16).contiguous()
    actions = torch.ones(199, 2)
    save_ted(flatten_trajectories([frames] * 3, [actions] * 3), tmp_path / "ted", task="sorting")
    partial, whole = get_task("po_sorting"), get_task("sorting")
    clean, noisy, again = (load_demonstrations(str(tmp_path), task) for task in (whole, partial, partial))
    assert torch.equal(noisy["observation"], again["observation"]) and torch.equal(noisy["action"], clean["action"])
    change = noisy["observation"] - clean["observation"]
    assert change[:, 2:4].std().item() == pytest.approx(partial.noise, rel=0.1) and partial.noise == 0.002
    others = [column for column in range(16) if column not in (2, 3)]
    assert not change[:, others].any()
    inner = (noisy["step_count"] < 198).squeeze(-1).nonzero().squeeze(-1)
    assert torch.equal(noisy["next", "observation"][inner], noisy["observation"][inner + 1])
    assert noisy["state"].shape[-1] == 10  # no yaw, of planner or controller
    stored = load_ted(tmp_path / "ted")
    assert torch.equal(stored["observation"], clean["observation"])
