# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests StackingExpert: it stacks in the requested order and acts through the environment alone."""

import numpy as np
import pytest
import torch
from expert_test_base import ContextExpertTestBase, first_attempts
from tensordict import TensorDict

from torchrl_koap.envs import StackingEnv
from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.envs.experts.stacking import StackingExpert
from torchrl_koap.tasks.stacking import ORDERS

LIMIT = 1000


class TestStackingExpert(ContextExpertTestBase):
    TASK, EXPERT, MODES = "stacking", StackingExpert, (4, 0)


@pytest.fixture(scope="module")
def played():
    return first_attempts("stacking", range(6), evaluation_contexts("stacking")[:6], [(1, mode) for mode in range(6)])


def test_every_order_is_stacked(played):
    found, env = played
    good = [row for row, attempt in enumerate(found) if not attempt.fault]
    assert len(good) >= 5
    for row in good:  # let go, and the pile stands
        assert 250 < found[row].steps < 680
        boxes = env.sims.object_poses[row, list(ORDERS[row])]
        np.testing.assert_allclose(boxes[:, :2], [(0.5, 0.2)] * 3, atol=0.03)
        np.testing.assert_allclose(boxes[:, 2], [0.011, 0.071, 0.131], atol=0.006)
        assert env.sims.gripper_width[row] > 0.07


def test_motion_is_smooth(played):
    for attempt in played[0]:
        joints, opens = attempt.actions[:, :7], attempt.actions[:, 7] > 0.075
        assert np.diff(opens).sum() == 6  # closed on every box once, opened once
        assert np.abs(joints).max() < 0.08 and np.quantile(np.abs(joints), 0.99) < 0.04
        assert np.quantile(np.abs(np.diff(joints, axis=0)), 0.99) < 0.01


def test_a_box_that_was_taken_away_is_fetched_again():
    context = evaluation_contexts("stacking")[:1]
    env, expert = StackingEnv(1, max_steps=LIMIT, dtype=torch.float64), StackingExpert([0], context, [0])
    out, stolen = env.reset(contexts=context), False
    for _ in range(LIMIT):
        out = env.step(TensorDict({"action": torch.as_tensor(expert.act(out["observation"].numpy()))}, [1]))["next"]
        data = env.sims.data[0]
        if not stolen and data.qpos[2] > 0.06:  # the red box is in the air: back to where it was
            data.qpos[:7], data.qvel[:6], stolen = (*context[0, 0, :2], 0.02, 1, 0, 0, 0), 0, True
        if out["success"].item():
            break
    assert stolen and out["success"].item() and out["mode"].tolist() == [[0, 1, 2]]
