# This source code is licensed under the MIT license found in the LICENSE file.
"""StackingExpert: takes the wanted order and plays through the environment alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from expert_test_base import ExpertTestBase, play
from tensordict import TensorDict

from torchrl_koap.envs import StackingEnv
from torchrl_koap.envs.contexts import draw_contexts, evaluation_contexts
from torchrl_koap.envs.experts.stacking import ORDERS, StackingExpert
from torchrl_koap.envs.mujoco.kinematics import follow_pose, tcp_pose
from torchrl_koap.envs.stacking import mode_index

LIMIT = 1000


class TestStackingExpert(ExpertTestBase):
    TASK, EXPERT, MODES = "stacking", StackingExpert, (4, 0)


def stack(modes, contexts, seeds):
    """Episodes played until the expert has drawn back, and which took the order asked for; environment and expert."""
    env, expert = StackingEnv(len(modes), max_steps=LIMIT, dtype=torch.float64), StackingExpert(modes, contexts, seeds)
    episodes = play(env, expert, contexts, LIMIT, to_the_end=True)
    return episodes, episodes.success & (mode_index(episodes.out["mode"]).numpy() == modes), env, expert


@pytest.fixture(scope="module")
def played():
    return stack(range(6), evaluation_contexts("stacking", 6), [(1, mode) for mode in range(6)])


def test_every_order_is_stacked(played):
    episodes, right, env, expert = played
    assert right.sum() >= 5
    assert ((episodes.told[right] > 250) & (episodes.told[right] < 650)).all()
    assert expert.finished[right].all()
    for row in np.flatnonzero(right & expert.finished):  # let go, and the pile stands
        boxes = env.sims.object_poses[row, list(ORDERS[row])]
        np.testing.assert_allclose(boxes[:, :2], [(0.5, 0.2)] * 3, atol=0.03)
        np.testing.assert_allclose(boxes[:, 2], [0.011, 0.071, 0.131], atol=0.006)
        assert env.sims.gripper_width[row] > 0.07


def test_motion_is_smooth(played):
    actions = np.swapaxes(played[0].actions, 0, 1)
    opens = actions[..., 7] > 0.075
    assert (np.diff(opens, axis=1).sum(1) == 6).all()  # closed on every box once, opened once
    assert set(np.unique(actions[..., 7])) == {0.06, 0.08}
    assert np.abs(actions[..., :7]).max() < 0.08
    assert np.quantile(np.abs(actions[..., :7]), 0.99) < 0.04
    assert np.quantile(np.abs(np.diff(actions[..., :7], axis=1)), 0.99) < 0.01


def test_a_box_that_was_taken_away_is_fetched_again():
    context = evaluation_contexts("stacking", 1)
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


def test_inverse_kinematics_reaches_poses():
    generator = np.random.default_rng(0)
    joints = np.array([StackingEnv.START_JOINTS] * 5)
    position, quaternion = tcp_pose(joints)
    position = position + generator.uniform(-0.02, 0.02, (5, 3))
    half = generator.uniform(-0.03, 0.03, 5)
    quaternion = np.stack([0 * half, np.cos(half), np.sin(half), 0 * half], 1)
    poses = np.concatenate([position, quaternion], 1)
    once = follow_pose(joints, poses)
    np.testing.assert_allclose(tcp_pose(once)[0], position, atol=1e-4)
    missing = np.abs(2 * half - 2 * np.arctan2(*tcp_pose(once)[1][:, [2, 1]].T))
    assert (missing < 0.4 * np.abs(2 * half) + 1e-3).all()
    reached = tcp_pose(follow_pose(joints, poses, substeps=300))
    np.testing.assert_allclose(reached[0], position, atol=1e-6)
    assert (np.abs((reached[1] * quaternion).sum(1)) > 1 - 1e-9).all()
    with pytest.raises(ValueError, match=r"joints must be \[n, 7\].*\[5, 6\]"):
        follow_pose(joints[:, :6], joints)
    with pytest.raises(ValueError, match="as many poses"):
        follow_pose(joints, joints[:2])


@pytest.mark.slow
@pytest.mark.parametrize("contexts", [evaluation_contexts("stacking"), draw_contexts("stacking", 60, 11)])
def test_success_in_many_contexts(contexts):
    wanted = np.arange(len(contexts)) % 6
    episodes, right, _, _ = stack(wanted, contexts, [(2, row) for row in range(len(contexts))])
    assert right.mean() > 0.9
    assert all(right[wanted == mode].mean() > 0.7 for mode in range(6))
    assert np.median(episodes.told[right]) < 600
