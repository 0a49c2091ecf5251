# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the registered Gymnasium environments behave like the batched environments they wrap."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from torchrl_koap.envs import AvoidingEnv, ManipulationGymEnv, SortingEnv, StackingEnv
from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.envs.registry import make_env
from torchrl_koap.tasks import get_task

NAMES = ("Avoiding", "Aligning", "Sorting2", "Sorting4", "Sorting6", "Stacking")


@pytest.mark.parametrize("name", ["torchrl_koap.envs:torchrl_koap/Avoiding-v0", "torchrl_koap/Sorting2-v0"])
def test_make_and_check(name):
    env = gymnasium.make(name)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Box observation space m.*imum value is")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("name", NAMES)
def test_layout_of_the_batched_environment(name):
    env = gymnasium.make(f"torchrl_koap/{name}-v0").unwrapped
    observation, info = env.reset(seed=0)
    assert observation.shape == (env.task.observation_dim,) and observation.dtype == np.float32
    assert env.action_space.shape == (env.task.action_dim,)
    np.testing.assert_array_equal(env.action_space.low, env.batched.action_spec.low[0].float())
    np.testing.assert_array_equal(env.action_space.high, env.batched.action_spec.high[0].float())
    assert env.batched.max_steps == env.task.max_steps
    assert env.metadata["render_fps"] == (33 if name == "Stacking" else 29)
    assert set(info) == {"success", "mode", "mode_index"} | ({"collision"} if name == "Avoiding" else {"context"})
    assert info["mode_index"] == -1 and not info["success"]


@pytest.mark.parametrize("task", [get_task("po_sorting"), replace(get_task("avoiding"), name="short", max_steps=7)])
def test_an_episode_ends_after_the_steps_of_the_task(task):
    assert make_env(task).max_steps == task.max_steps
    assert make_env(task, max_steps=3).max_steps == 3
    env = ManipulationGymEnv(replace(task, max_steps=1))
    env.reset(seed=0)
    assert env.step(np.zeros(2))[2:4] == (False, True)  # truncated, not terminated


@pytest.mark.parametrize(
    ("make", "name"), [(SortingEnv, "po_sorting"), (StackingEnv, "stacking_1"), (AvoidingEnv, "avoiding")]
)
def test_an_environment_takes_a_variant_of_its_task(make, name):
    task = replace(get_task(name), max_steps=2)
    env = make(task=task)
    assert env.task is task and env.rollout(9)["next", "truncated"].flatten().tolist() == [False, True]


def test_the_noise_of_a_task_is_added_on_request():
    task = replace(get_task("avoiding"), noise=0.003)
    clean, noisy = (make_env(task, 100, noisy=noisy).reset()["observation"] for noisy in (False, True))
    assert torch.equal(clean[:, 2:], clean[:, :2]) and torch.equal(noisy[:, :2], clean[:, :2])
    assert (noisy - clean)[:, 2:].std().item() == pytest.approx(0.003, rel=0.2)


def test_seeds_make_contexts_repeatable():
    env = gymnasium.make("torchrl_koap/Sorting2-v0")
    found = [[env.reset(seed=seed)[1]["context"], env.reset()[1]["context"]] for seed in (3, 3, 4)]
    np.testing.assert_array_equal(found[0], found[1])
    apart = [found[0][0], found[0][1], found[2][0]]
    assert all(np.abs(a - b).max() > 1e-3 for i, a in enumerate(apart) for b in apart[:i])


def test_a_context_that_is_asked_for():
    env = gymnasium.make("torchrl_koap/Aligning-v0").unwrapped
    context = evaluation_contexts(env.task)[7]
    observation, info = env.reset(options={"context": context})
    np.testing.assert_array_equal(info["context"], context)
    wanted = make_env(env.task).reset(contexts=context[None])
    np.testing.assert_array_equal(observation, wanted["observation"][0])
    info = env.step(env.action_space.sample() * 0)[4]
    np.testing.assert_array_equal(info["context"], context)
    assert info["mode_index"] == info["mode"][0] == 1  # the rod starts outside


def test_bad_options():
    env = gymnasium.make("torchrl_koap/Aligning-v0").unwrapped
    with pytest.raises(ValueError, match="outside its region"):
        env.reset(options={"context": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="only option of reset.* is 'context', got 'contexts'"):
        env.reset(options={"contexts": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="'avoiding' has no contexts"):
        gymnasium.make("torchrl_koap/Avoiding-v0").unwrapped.reset(options={"context": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array', got 'human'"):
        ManipulationGymEnv("avoiding", render_mode="human")


def test_same_episode_as_the_batched_environment():
    env, batched = gymnasium.make("torchrl_koap/Avoiding-v0"), AvoidingEnv(1)
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


def test_picture(graphics):
    env = gymnasium.make("torchrl_koap/Avoiding-v0", render_mode="rgb_array", width=64, height=48)
    env.reset()
    picture = env.render()
    assert picture.shape == (48, 64, 3) and picture.std() > 5
    env.close()
