# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests StackingEnv: parity with recordings of the original, success, gripper, contexts, partial steps."""

import numpy as np
import pytest
import torch
from env_test_base import (
    ContextTestBase,
    act,
    assert_starts_as_recorded,
    contexts_of,
    recordings_of,
    replay,
    start_from,
)

from torchrl_koap.envs import StackingEnv
from torchrl_koap.tasks import get_task

STILL_OPEN = torch.tensor([0.0] * 7 + [0.08], dtype=torch.float64)
STILL_CLOSED = torch.zeros(8, dtype=torch.float64)


class TestStackingEnv(ContextTestBase):
    ENV = StackingEnv
    PUSH = [0.01] * 7 + [0.08]

    def test_ranges_of_actions_and_the_gripper_of_a_step(self):
        env = self.make(3)
        bounds = env.action_spec.space
        assert bounds.low[0].tolist() == pytest.approx([-0.03] * 7 + [0.0])
        assert bounds.high[0].tolist() == pytest.approx([0.03] * 7 + [0.08])
        env.reset()
        act(env, STILL_CLOSED)
        act(env, self.PUSH, mask=[True, False, False])
        assert env.sims.grasping.tolist() == [False, True, True]


def put_boxes(env, positions, index=0):
    """Starts an episode with the boxes in the air at ``positions`` [3, 3]."""
    qpos = env.sims.data[index].qpos.copy()
    qpos[:21] = np.concatenate([positions, np.tile((1, 0, 0, 0), (3, 1))], axis=1).ravel()
    start_from(env, index, qpos=qpos)


def test_parity_with_the_original():
    recorded = recordings_of("stacking")
    env = StackingEnv(4, max_steps=5000, dtype=torch.float64)
    env.reset(contexts=contexts_of(recorded, 3))
    assert_starts_as_recorded(env, recorded)
    succeeded = np.zeros(4, dtype=bool)

    def check(i, k, out, where):
        assert np.abs(env.sims.tcp_position[i] - recorded[f"ep{i}_c_pos"][k]).max() < 1e-7, where  # 1e-4 mm
        assert np.abs(env.sims.object_poses[i] - recorded[f"ep{i}_obj_pose"][k]).max() < 1e-6, where
        assert np.abs(env.sims.joint_positions[i] - recorded[f"ep{i}_j_pos"][k]).max() < 1e-6, where
        assert np.abs(env.sims.gripper_width[i] - recorded[f"ep{i}_gripper_width"][k]) < 1e-6, where
        seen = out["observation"][i, 8:20].reshape(3, 4).numpy()
        wanted = recorded[f"ep{i}_obs_step"][k].reshape(3, 4)
        np.testing.assert_allclose(seen[:, :3], wanted[:, :3], rtol=0, atol=1e-6, err_msg=where)
        turn = np.arctan(seen[:, 3]) - np.arctan(wanted[:, 3].astype(np.float64))
        assert np.abs(np.sin(turn)).max() < 1e-5, where  # the tangent has poles, its angle has none
        assert out["mode"][i].tolist() == recorded[f"ep{i}_mode"][k].tolist(), where
        done = bool(recorded[f"ep{i}_done"][k])
        assert out["done"][i].item() == out["success"][i].item() == done, where
        # the original's success flag is that of the state after the step: ours, told a step later
        assert env._seen[i, 0] == bool(recorded[f"ep{i}_success"][k]), where
        succeeded[i] |= done
        arrived = (out["mode"][i] >= 0).sum().item()
        first, second, _ = recorded[f"ep{i}_success1_success2_meandist"][k]
        assert (arrived >= 1, arrived >= 2) == (bool(first), bool(second)), where

    replay(env, recorded, check, 7)
    assert succeeded.tolist() == [True, False, False, False]


def test_columns_of_the_observation():
    env, parts = StackingEnv(2, dtype=torch.float64, seed=1), get_task("stacking").observation
    first = env.reset()
    seen = {name: first["observation"][:, columns] for name, columns in parts.items()}
    equal = {"rtol": 0, "atol": 0}
    torch.testing.assert_close(seen["desired_joints_and_gripper"][:, :7], seen["measured_joints"], **equal)
    torch.testing.assert_close(seen["desired_joints_and_gripper"][:, 7:], seen["gripper_width"], **equal)
    tcp = torch.tensor([[0.524978, 0.0, 0.301514]], dtype=torch.float64).expand(2, 3)
    torch.testing.assert_close(seen["tcp_position"], tcp, rtol=0, atol=1e-6)
    for index, name in enumerate(("red", "green", "blue")):
        torch.testing.assert_close(seen[f"{name}_position"][:, :2], first["context"][:, index, :2], rtol=0, atol=1e-6)
        tangent = first["context"][:, index, 2:].tan()
        torch.testing.assert_close(seen[f"{name}_tan_yaw"], tangent, rtol=1e-4, atol=1e-6)
    action = torch.arange(8, dtype=torch.float64) * 1e-3
    for step in range(1, 4):
        after = act(env, action)["observation"]
        torch.testing.assert_close(after[:, :7] - first["observation"][:, :7], step * action[:7].expand(2, 7))
        torch.testing.assert_close(after[:, 7], torch.full((2,), 0.007, dtype=torch.float64), **equal)


def test_gripper_threshold():
    env = StackingEnv(3, dtype=torch.float64, seed=0)
    env.reset()
    for _ in range(12):
        act(env, STILL_OPEN)
    assert env.sims.gripper_width == pytest.approx(0.08, abs=2e-3)
    actions = torch.zeros(3, 8, dtype=torch.float64)
    actions[:, 7] = torch.tensor([0.0751, 0.075, 0.0], dtype=torch.float64)
    for _ in range(12):
        act(env, actions)
    assert env.sims.gripper_width == pytest.approx([0.08, 0.0, 0.0], abs=5e-3)
    np.testing.assert_allclose(env.sims.object_poses[:, :, 2], 0.011, atol=1e-3)  # popped up onto the table


ON_TABLE = [(0.4, -0.2, 0.011), (0.4, -0.05, 0.011), (0.6, -0.1, 0.011)]
PILED = [(0.50, 0.20, 0.011), (0.52, 0.20, 0.072), (0.49, 0.21, 0.133)]
# positions of the boxes, and success with one, two and three boxes
OUTCOMES = (
    (PILED, (True, True, True)),
    ([*PILED[:2], ON_TABLE[2]], (True, True, False)),
    ([ON_TABLE[0], PILED[0], ON_TABLE[2]], (True, False, False)),
    (ON_TABLE, (False, False, False)),
    # all three in the zone, two of them side by side
    ([(0.465, 0.2, 0.011), (0.535, 0.2, 0.011), (0.5, 0.2, 0.072)], (True, True, False)),
)


@pytest.mark.parametrize("num_boxes", [1, 2, 3])
def test_success_of_one_two_or_three_boxes(num_boxes):
    env = StackingEnv(len(OUTCOMES), num_boxes=num_boxes, dtype=torch.float64, seed=0)
    env.reset()
    for index, (positions, _) in enumerate(OUTCOMES):
        put_boxes(env, positions, index)
    told = [act(env, STILL_OPEN) for _ in range(5)]
    wanted = [outcome[num_boxes - 1] for _, outcome in OUTCOMES]
    assert told[-1]["success"][:, 0].tolist() == told[-1]["terminated"][:, 0].tolist() == wanted
    assert told[-1]["reward"][:, 0].tolist() == [float(success) for success in wanted]
    if num_boxes < 3:  # boxes arrive one per step and success comes a step after the last of them
        seen = [[out["success"][row].item() for out in told] for row in np.flatnonzero(wanted)]
        assert seen == [[step >= num_boxes for step in range(5)]] * sum(wanted)


def test_boxes_are_recorded_nearest_first_and_stay_recorded():
    env = StackingEnv(1, dtype=torch.float64, seed=0)
    env.reset()
    put_boxes(env, [(0.53, 0.20, 0.011), (0.50, 0.20, 0.072), (0.6, -0.1, 0.011)])
    assert [act(env, STILL_OPEN)["mode"][0].tolist() for _ in range(3)] == [[1, -1, -1], [1, 0, -1], [1, 0, -1]]
    env.sims._object_views[0][:14] = [0.4, -0.2, 0.011, 1, 0, 0, 0, 0.4, -0.05, 0.011, 1, 0, 0, 0]
    assert act(env, STILL_OPEN)["mode"][0].tolist() == [1, 0, -1]


@pytest.mark.parametrize("num_boxes", [0, 4, -1, "two"])
def test_other_counts_are_refused(num_boxes):
    with pytest.raises(ValueError, match=f"num_boxes must be 1, 2 or 3.*{num_boxes}"):
        StackingEnv(1, num_boxes=num_boxes)


def test_raw_log_holds_joints_and_boxes_but_no_pose_command():
    env = StackingEnv(2, dtype=torch.float64, seed=0)
    env.reset()
    act(env, [0.01] * 7 + [0.08])
    log, poses = env.raw_log()
    assert "des_c_pos" not in log
    np.testing.assert_array_equal(log["des_j_pos"], env.commands[:, :7])
    assert log["gripper_width"].shape == (2,)
    assert poses.shape == (2, 3, 7)
