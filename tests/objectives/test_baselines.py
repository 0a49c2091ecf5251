# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the loss of predicted actions: a plain loop, padding, and the tests of all losses."""

import pytest
import torch
from inverse_dynamics_test_base import KEYS, T, normalizers, partly_labelled
from loss_test_base import LossTestBase

from torchrl_koap.modules import SupervisedInverseDynamics, make_koopman_inverse_dynamics
from torchrl_koap.objectives import ActionLoss, KOAPLoss


def make_loss(seed=0, **options):
    torch.manual_seed(seed)
    network = SupervisedInverseDynamics(3, 2, num_past=1, **normalizers())
    return ActionLoss(network, **options)


def windows(*batch):
    return partly_labelled(*batch).exclude("padded")


class TestActionLoss(LossTestBase):
    default_keys = KEYS
    in_names, out_keys = ("state", "action", "has_action"), ("loss_action",)
    learning_rate = 1e-2

    make_loss = staticmethod(make_loss)
    make_batch = staticmethod(windows)

    def counted(self, batch, key, elements):
        return int(batch["has_action"][..., 1:-1, :].sum())


@pytest.mark.parametrize("trailing", [True, False])
def test_equals_a_plain_loop(trailing):
    loss, batch = make_loss(), windows(4)
    padded = torch.zeros(4, T, 1, dtype=torch.bool)
    padded[0, :3], padded[1, -2:] = True, True
    prediction = loss.network(batch.clone())["action"]
    scale = torch.tensor([0.5, 2.0])
    errors = []
    for row in range(4):
        for frame in range(1, T - 1):
            if batch["has_action"][row, frame] and not (padded[row, frame] or padded[row, frame + 1]):
                errors.append((((prediction - batch["action"])[row, frame] / scale) ** 2).mean())
    batch["padded"] = padded if trailing else padded.squeeze(-1)
    assert 5 < len(errors) < batch["has_action"].sum()
    torch.testing.assert_close(loss(batch)["loss_action"], torch.stack(errors).mean())


def test_actions_of_another_width_are_refused_and_not_broadcast():
    network = SupervisedInverseDynamics(3, 2, num_past=1)
    batch = windows(4)
    batch["action"] = batch["action"][..., :1].contiguous()
    with pytest.raises(ValueError, match="'action' has 1 columns, the network decodes 2"):
        ActionLoss(network)(batch)
    lifted = KOAPLoss(make_koopman_inverse_dynamics(3, 2, num_past=2, look_ahead=(2,)))
    with pytest.raises(ValueError, match="'action' has 1 columns, the network decodes 2"):
        lifted(batch)
