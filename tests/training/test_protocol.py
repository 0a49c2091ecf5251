# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's baselines and settings in training: weights of losses, revised methods, noise of PO-Sorting's data."""

from __future__ import annotations

import pytest
from tiny_runs import TINY, koap

from torchrl_koap.evaluation import load_run
from torchrl_koap.modules import SupervisedInverseDynamics, VariationalInverseDynamics
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.weights import load_tensors
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


def test_the_auto_encoder_reads_the_window_that_policies_hand_it():
    resolved = resolve(TrainConfig(out="run", method="vae"))
    model = resolved.method.build(2, 2, {}, resolved.controller)
    assert isinstance(model, VariationalInverseDynamics) and model.num_window_frames == 16


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
