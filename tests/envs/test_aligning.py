# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests AligningEnv: parity with recordings of the original, contexts, success rule, partial resets, pictures."""

import math

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
    start_recorded,
)

from torchrl_koap.envs import AligningEnv
from torchrl_koap.envs.aligning import INSIDE_REACH
from torchrl_koap.envs.contexts import yaw_quaternions

SENSITIVE = 1  # the recorded episode in which a start error of 1e-8 rad grows to millimetres
CONTEXT = np.array([[(0.5, -0.15, 0.3), (0.55, 0.3, -0.7)]])
DOWN = torch.tensor([0.0, 0.0, -0.01], dtype=torch.float64)


class TestAligningEnv(ContextTestBase):
    ENV = AligningEnv
    PUSH = DOWN.tolist()


def put(env, tray, tcp=None):
    """Shows the checks a tray pose [7] and a TCP position [3] without running physics."""
    env.sims._object_views[0][:] = tray
    if tcp is not None:
        env.sims._tcp_views[0][:] = tcp


def test_parity_with_the_original():
    recorded = recordings_of("aligning")
    env = AligningEnv(4, max_steps=1000, dtype=torch.float64)
    first = env.reset(contexts=contexts_of(recorded, 2))
    assert_starts_as_recorded(env, recorded)
    for i in range(4):
        np.testing.assert_allclose(first["observation"][i, 3:], recorded[f"ep{i}_init_obs"], rtol=0, atol=1e-7)
    start_recorded(env, recorded)
    first_contact = np.append(np.flatnonzero(recorded[f"ep{SENSITIVE}_robot_touches_object"]), 10**6)[0]
    success_told = np.zeros(4, dtype=bool)

    def check(i, k, out, where):
        assert out["done"][i].item() == bool(recorded[f"ep{i}_done"][k]), where
        assert out["mode"][i].item() == recorded[f"ep{i}_mode"][k], where
        success_told[i] = recorded[f"ep{i}_success"][k]
        if i == SENSITIVE and k >= first_contact:
            return
        assert np.abs(env.sims.tcp_position[i] - recorded[f"ep{i}_c_pos"][k]).max() < 1e-6, where
        assert np.abs(env.sims.data[i].qpos - recorded[f"ep{i}_qpos"][k]).max() < 1e-5, where
        observed = np.abs(out["observation"][i, 3:].numpy() - recorded[f"ep{i}_obs_step"][k]).max()
        assert observed < 1e-6, where  # recorded in float32

    out = replay(env, recorded, check, 3)
    # the original tells success with the step that reaches it, this environment with the one that ends the episode
    assert out["success"][:, 0].tolist() == success_told.tolist() == [True, False, False, False]


def test_first_observation_and_latency_of_one_step():
    env = AligningEnv(1, dtype=torch.float64)
    first = env.reset(contexts=CONTEXT)
    seen = first["observation"][0].numpy()
    np.testing.assert_allclose(seen[:3], [0.524958, -0.348818, 0.251598], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(seen[3:6], seen[:3])
    np.testing.assert_allclose(seen[6:9], [0.5, -0.15, 0.0], rtol=0, atol=1e-4)  # one substep of falling
    np.testing.assert_allclose(seen[9:13], yaw_quaternions(np.array(0.3)), rtol=0, atol=1e-4)
    np.testing.assert_allclose(seen[13:16], [0.55, 0.3, 0.0])
    np.testing.assert_allclose(seen[16:], yaw_quaternions(np.array(-0.7)))
    np.testing.assert_array_equal(first["context"], CONTEXT)
    assert env.task.modes.index_of(first["mode"]).tolist() == [-1]
    step, before = torch.tensor([0.005, 0.010, -0.006], dtype=torch.float64), seen[3:13]
    for k in range(1, 6):
        out = act(env, step)["observation"][0].numpy()
        np.testing.assert_allclose(out[:3], seen[:3] + k * step.numpy(), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(out[3:13], before)
        before = np.concatenate([env.sims.tcp_position[0], env.sims.object_poses[0, 0]])
    np.testing.assert_array_equal(env.commands[0, 3:], [0, 1, 0, 0])


def test_tray_comes_to_rest_on_the_table():
    env = AligningEnv(1, dtype=torch.float64)
    env.reset(contexts=CONTEXT)
    for _ in range(15):
        out = act(env, torch.zeros(3))
    np.testing.assert_allclose(out["observation"][0, 6:9], [0.5, -0.15, -0.0091], rtol=0, atol=2e-4)
    logged = env.raw_log()[1][0]  # tray, target
    np.testing.assert_allclose(logged[0, :3], [0.5, -0.15, -0.0091], rtol=0, atol=2e-4)
    np.testing.assert_array_equal(logged[1], env.targets[0])
    tray = env.sims.model.body("box")
    assert tray.mass[0] == pytest.approx(1.004)
    np.testing.assert_allclose(tray.inertia, [0.00168003, 0.00088542, 0.00088542], rtol=1e-5)


@pytest.mark.parametrize(
    ("shift", "turn", "wanted"),
    [
        ((0.0, 0.0, 0.0), 0.0, True),  # exact alignment: the original's arccos of more than 1 would be NaN
        ((0.0, 0.0, 0.0), 1e-9, True),
        ((0.015, 0.0, -0.0091), 0.0, True),
        ((0.016, 0.0, -0.0091), 0.0, False),  # the height takes part
        ((0.0, 0.0179, 0.0), 0.0, True),
        ((0.0, 0.0181, 0.0), 0.0, False),
        ((0.0, 0.0, 0.0), 8.6, True),
        ((0.0, 0.0, 0.0), -8.6, True),
        ((0.0, 0.0, 0.0), 8.7, False),
        ((0.0, 0.0, 0.0), 180.0, False),
        ((0.0, 0.0, 0.0), 352.0, True),
    ],
)
def test_success_rule(shift, turn, wanted):
    env = AligningEnv(1, dtype=torch.float64)
    env.reset(contexts=CONTEXT)
    x, y, yaw = CONTEXT[0, 1]
    tray = np.append(np.add([x, y, 0.0], shift), yaw_quaternions(np.array(yaw + math.radians(turn))))
    for sign in (1, -1):  # q and -q are the same rotation
        put(env, np.append(tray[:3], sign * tray[3:]))
        success, failure = env._check(np.array([0]))
        assert success.tolist() == [wanted] and failure.tolist() == [False]


def test_mode_is_that_of_the_last_instant():
    env = AligningEnv(1, dtype=torch.float64)
    env.reset(contexts=CONTEXT)
    for tcp, mode in (
        ((0.5, -0.15, 0.3), 0),
        ((0.5 + INSIDE_REACH + 1e-6, -0.15, 0.1), 1),
        ((0.5, -0.15 - INSIDE_REACH + 1e-6, 0.1), 0),
        ((0.54, -0.19, 0.1), 1),
    ):
        put(env, [0.5, -0.15, 0, 1, 0, 0, 0], tcp)
        env._update_mode(np.array([0]))
        assert env._mode.tolist() == [[mode]], tcp


def drawn_target(env, index):
    """Where pictures show the target's base: position, and direction of its x axis."""
    site, data = env.sims.model.site("target_base").id, env.sims.data[index]
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3)[:2, 0].copy()


def test_target_is_drawn_at_its_place_from_the_first_picture_on():
    env = AligningEnv(2, dtype=torch.float64)
    other = CONTEXT + np.array([0.04, 0.02, 0.5])
    for contexts in (np.concatenate([CONTEXT, other]), np.concatenate([other, CONTEXT])):
        env.reset(contexts=contexts)
        for moment in ("reset", "step"):
            for index in range(2):
                position, axis = drawn_target(env, index)
                x, y, yaw = contexts[index, 1]
                np.testing.assert_allclose(position, [x, y, 0.0], atol=1e-12, err_msg=moment)
                np.testing.assert_allclose(axis, [math.cos(yaw), math.sin(yaw)], atol=1e-12, err_msg=moment)
            act(env, DOWN)
