# This source code is licensed under the MIT license found in the LICENSE file.
"""The Gymnasium registration behaves like the batched environment it wraps."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from torchrl_koap.envs import AvoidingEnv


@pytest.mark.parametrize("name", ["torchrl_koap/Avoiding-v0", "torchrl_koap.envs:torchrl_koap/Avoiding-v0"])
def test_make_and_check(name):
    env = gymnasium.make(name)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space m.*imum value is")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_same_episode_as_the_batched_environment():
    env, batched = gymnasium.make("torchrl_koap/Avoiding-v0", max_steps=60), AvoidingEnv(1, max_steps=60)
    observation, info = env.reset(seed=1)
    tensordict = batched.reset()
    np.testing.assert_array_equal(observation, tensordict["observation"][0])
    assert info["mode_index"] == -1 and not info["success"]
    action, ended = np.array([-0.001, 0.010], dtype=np.float32), False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(action)
        out = batched.step(tensordict.set("action", torch.from_numpy(action)[None]))["next"]
        np.testing.assert_array_equal(observation, out["observation"][0])
        assert (reward, terminated, truncated) == (0.0, out["terminated"].item(), out["truncated"].item())
        np.testing.assert_array_equal(info["mode"], out["mode"][0])
        ended = terminated or truncated
    assert info["collision"] and terminated and not info["success"]


def test_vector_environment():
    envs = gymnasium.make_vec("torchrl_koap/Avoiding-v0", num_envs=2, vectorization_mode="sync")
    observation, _ = envs.reset(seed=0)
    assert observation.shape == (2, 4)
    envs.close()


def test_unknown_render_mode():
    from torchrl_koap.envs import AvoidingGymEnv

    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array', got 'human'"):
        AvoidingGymEnv(render_mode="human")


def test_bad_action():
    env = gymnasium.make("torchrl_koap/Avoiding-v0").unwrapped
    env.reset()
    with pytest.raises(ValueError, match="'action' must have shape"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="'action' must be finite"):
        env.step(np.array([np.nan, 0]))


def test_picture():
    env = gymnasium.make("torchrl_koap/Avoiding-v0", render_mode="rgb_array", width=64, height=48)
    env.reset()
    try:
        picture = env.render()
    except RuntimeError as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")
    assert picture.shape == (48, 64, 3) and picture.std() > 5
    env.close()
