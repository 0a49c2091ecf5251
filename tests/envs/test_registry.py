# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the registered Gymnasium environments behave like the batched environments they wrap."""

import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_koap.envs import AvoidingEnv, ManipulationGymEnv, SortingEnv, StackingEnv
from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.envs.registry import make_env
from torchrl_koap.tasks import Action, Task, get_task

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


class Reach(EnvBase):
    """An environment of a user, without a mode if ``lacks`` says so."""

    def __init__(self, num_envs, max_steps, dtype=torch.float32, *, lacks="", columns=4, actions=2, batch=None):
        super().__init__(batch_size=[num_envs] if batch is None else batch)
        entries = {"observation": columns, "success": 1, "mode": 1}
        shown = {name: Unbounded((num_envs, width), dtype=dtype) for name, width in entries.items() if name != lacks}
        self.observation_spec = Composite(shown, shape=self.batch_size)
        self.action_spec = Unbounded((num_envs, actions), dtype=dtype)
        self.max_steps = max_steps

    def _reset(self, tensordict=None, **_):
        return self.observation_spec.zero()

    def _step(self, tensordict):
        raise NotImplementedError

    def _set_seed(self, seed):
        pass


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"lacks": "mode"}, "its observation_spec has no entry 'mode'"),
        ({"max_steps": None}, "it has no attribute 'max_steps'"),
        ({"lacks": "success"}, "its observation_spec has no entry 'success'"),
        ({"batch": []}, r"its batch size is \[\], wanted \[1\]"),
        ({"columns": 5}, "its observations have 5 columns, the task's 4"),
        ({"actions": 3}, "its actions have 3 columns, the task's 2"),
        ({"num_threads": 2}, r"'test_registry:Reach' cannot be made: .* unexpected keyword argument 'num_threads'"),
    ],
)
def test_an_environment_that_lacks_a_part_of_the_interface_is_refused(options, says, monkeypatch):
    monkeypatch.setitem(sys.modules, "test_registry", sys.modules[__name__])
    own = {"observation_parts": {"xy": 2, "goal": 2}, "actions": {"dx": Action("m"), "dy": Action("m")}}
    task = Task(name="reach", position="xy", env="test_registry:Reach", **own)
    assert make_env(task, 3).batch_size == torch.Size([3])
    with pytest.raises(ValueError, match=f"^env of task 'reach'.*{says}"):
        make_env(task, **options)


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


def test_the_camera_of_the_task_draws_the_picture(graphics):
    task = get_task("avoiding")
    task = replace(task, scene=replace(task.scene, camera="wrist"))
    env = ManipulationGymEnv(task, render_mode="rgb_array", width=64, height=48)
    env.reset()
    np.testing.assert_array_equal(env.render(), env.batched.render(0, 64, 48, "wrist"))
    np.testing.assert_array_equal(env.batched.render(0, 64, 48), env.batched.render(0, 64, 48, "front"))
    env.close()
