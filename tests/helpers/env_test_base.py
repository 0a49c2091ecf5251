# This source code is licensed under the MIT license found in the LICENSE file.
"""Base class of tests for the environments of D3IL's tasks; a test file per task subclasses it."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_koap.envs.contexts import draw_contexts, evaluation_contexts
from torchrl_koap.envs.mujoco.controller import FINGER_OPEN

# recordings and human demonstrations that the package does not ship; tests that need them are skipped without
SHARED = Path(os.environ.get("KOAP_SHARED", Path(__file__).parents[3] / "shared"))
HUMAN = SHARED / "d3il_avoiding_human"
MUJOCO = "4."  # the recordings were made with this version; others differ by micrometres
OTHER_MUJOCO = not mujoco.__version__.startswith(MUJOCO)
WHY_OTHER = f"the recordings are of MuJoCo {MUJOCO}x, this is {mujoco.__version__}"


def act(env, action, mask=None):
    """Makes one control step of every environment, or of those in the mask."""
    action = torch.as_tensor(action, dtype=env._dtype).expand(env.batch_size[0], env.task.action_dim)
    tensordict = TensorDict({"action": action}, env.batch_size)
    if mask is not None:
        tensordict["_step"] = torch.as_tensor(mask).reshape(-1, 1)
    return env.step(tensordict)["next"]


def recordings_of(task):
    """Loads four recorded episodes of the original simulator, see :func:`start_recorded` and :func:`replay`."""
    file = SHARED / "d3il_reference" / f"{task}.npz"
    if not file.exists():
        pytest.skip(f"no recordings at {file}")
    if OTHER_MUJOCO:
        pytest.skip(WHY_OTHER)
    return np.load(file)


def contexts_of(recorded, objects):
    """Returns the contexts of the four recorded episodes, yaw in rad."""
    contexts = np.stack([recorded[f"ep{episode}_context"][:objects, :3] for episode in range(4)]).astype(np.float64)
    contexts[..., 2] = np.radians(contexts[..., 2])
    return contexts


def start_from(env, index, **state):
    """Starts an episode of one environment from a physics state, without context and past of the controller."""
    data = env.sims.data[index]
    mujoco.mj_resetData(env.sims.model, data)
    for name, value in state.items():
        getattr(data, name)[:] = value
    data.time = 0.001
    mujoco.mj_forward(env.sims.model, data)
    data.qacc_warmstart[:] = state.get("qacc_warmstart", data.qacc_warmstart)  # mj_forward overwrites it
    env.sims.started[index], env.sims.widths[index] = False, FINGER_OPEN
    env._begin_episode(np.array([index]))


def start_recorded(env, recorded):
    """Puts four environments into the first states of the recorded episodes."""
    for episode in range(4):
        names = ("qpos", "qvel", "qacc_warmstart", "ctrl")
        start_from(env, episode, **{name: recorded[f"ep{episode}_init_{name}"] for name in names})


def assert_starts_as_recorded(env, recorded):
    for episode, data in enumerate(env.sims.data):
        np.testing.assert_allclose(data.qpos, recorded[f"ep{episode}_init_qpos"], rtol=0, atol=1e-14)
        np.testing.assert_allclose(data.qvel, recorded[f"ep{episode}_init_qvel"], rtol=0, atol=1e-12)


def replay(env, recorded, check, moved):
    """Replays the recorded commands; the first ``moved`` entries are sent as changes of the command.

    Calls ``check(episode, step, leaves, where)`` after every control step of an episode; returns the last leaves.
    """
    lengths = recorded["n_steps"]
    for step in range(max(lengths)):
        running = lengths > step
        action = np.stack([recorded[f"ep{i}_action"][min(step, lengths[i] - 1)] for i in range(4)])
        action = action[:, : env.task.action_dim].astype(np.float64)
        action[:, :moved] -= env.commands[:, :moved]
        out = act(env, action, running)
        for episode in np.flatnonzero(running):
            check(episode, step, out, f"episode {episode}, step {step}")
    return out


class EnvTestBase:
    """Tests of batches, partial resets and steps, saved states, contexts and errors."""

    ENV: type  # the environment
    PUSH: list  # an action that moves something
    STEPS = 20  # control steps until it has moved

    def make(self, num_envs=1, **options):
        return self.ENV(num_envs, **({"dtype": torch.float64, "seed": 0} | options))

    def contexts(self, env):
        return {"contexts": draw_contexts(env.task, 5, 3)[: env.batch_size[0]]} if env.task.objects else {}

    @pytest.mark.parametrize(("num_envs", "dtype"), [(1, torch.float32), (3, torch.float64)])
    def test_specs(self, num_envs, dtype):
        env = self.make(num_envs, dtype=dtype)
        check_env_specs(env)
        assert env.rollout(2)["next", "observation"].dtype == dtype

    def leaves(self, env):
        """Returns the leaves of a few steps with different pushes."""
        share = torch.linspace(0.5, 1, 5, dtype=torch.float64)[: env.batch_size[0], None]
        start = env.reset(**self.contexts(env))
        push = (share * torch.tensor(self.PUSH, dtype=torch.float64)).to(env._dtype)
        options = {"auto_reset": False, "tensordict": start, "break_when_any_done": False}
        steps = env.rollout(self.STEPS, lambda td: td.set("action", push), **options)
        return steps.exclude("action", "_reset")

    def test_batch_size_and_threads_change_nothing(self):
        alone = self.leaves(self.make(5))
        torch.testing.assert_close(self.leaves(self.make(5, num_threads=2)), alone, rtol=0, atol=0)
        torch.testing.assert_close(self.leaves(self.make(2)), alone[:2], rtol=0, atol=0)

    def test_partial_reset_leaves_the_others_alone(self):
        env, plain = self.make(3), self.make(3)
        start = env.reset(**self.contexts(env))
        plain.reset(**self.contexts(plain))
        for _ in range(10):
            act(env, self.PUSH), act(plain, self.PUSH)
        before = [data.qpos.copy() for data in env.sims.data]
        mask = TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3])
        again = {name: values[1:2] for name, values in self.contexts(env).items()}
        out = env.reset(mask, **again)
        torch.testing.assert_close(out["observation"][1], start["observation"][1], rtol=0, atol=0)
        for row in (0, 2):
            np.testing.assert_array_equal(env.sims.data[row].qpos, before[row])
        for _ in range(self.STEPS):
            got, wanted = act(env, self.PUSH), act(plain, self.PUSH)
            torch.testing.assert_close(got[[0, 2]], wanted[[0, 2]], rtol=0, atol=0)
        assert env._steps.tolist() == [10 + self.STEPS, self.STEPS, 10 + self.STEPS]

    def test_partial_step_freezes_the_others(self):
        env = self.make(2)
        env.reset(**self.contexts(env))
        held = act(env, self.PUSH)
        before = env.sims.data[1].qpos.copy()
        bad_where_skipped = torch.tensor([self.PUSH, [float("nan")] * len(self.PUSH)])
        out = act(env, bad_where_skipped, mask=[True, False])
        np.testing.assert_array_equal(env.sims.data[1].qpos, before)
        torch.testing.assert_close(out["observation"][1], held["observation"][1], rtol=0, atol=0)
        assert not torch.equal(out["observation"][0], held["observation"][0])
        assert env._steps.tolist() == [2, 1] and env._ready.all()

    def test_full_state_round_trip(self):
        env = self.make(2)
        env.reset(**self.contexts(env))
        for _ in range(self.STEPS):
            act(env, self.PUSH, mask=[True, False])
        env.set_state(1, env.get_state(0))
        for _ in range(5):
            out = act(env, self.PUSH)
            torch.testing.assert_close(out[1], out[0], rtol=0, atol=0)
            np.testing.assert_array_equal(env.sims.data[0].qpos, env.sims.data[1].qpos)
        np.testing.assert_array_equal(env.sims.data[0].mocap_pos, env.sims.data[1].mocap_pos)

    @pytest.mark.parametrize("max_steps", [1, 4])
    def test_truncation_in_call_number_max_steps(self, max_steps):
        still = torch.zeros(2, len(self.PUSH), dtype=torch.float64)
        out = self.make(2, max_steps=max_steps).rollout(10, lambda td: td.set("action", still))
        assert out.shape == (2, max_steps)
        assert out["next", "truncated"][:, -1].all() and not out["next", "terminated"].any()
        assert not out["next", "success"].any()

    def test_actions_that_cannot_be_executed_are_refused(self):
        env, width = self.make(3), len(self.PUSH)
        with pytest.raises(RuntimeError, match="before the first reset"):
            act(env, self.PUSH)
        tensordict = env.reset()
        with pytest.raises(ValueError, match=rf"shape \[3, {width}\].*got shape \[3, {width + 1}\]"):
            env.step(tensordict.clone().set("action", torch.zeros(3, width + 1)))
        with pytest.raises(ValueError, match="got none"):
            env.step(tensordict.clone())
        for value in (float("nan"), float("inf")):
            actions = torch.zeros(3, width)
            actions[1, 0] = value
            with pytest.raises(ValueError, match="'action' must be finite.*environment 1"):
                act(env, actions)

    def test_bad_arguments_are_named(self):
        for name, value in {"num_envs": 0, "num_threads": 0, "max_steps": 2.5, "dtype": torch.int64}.items():
            with pytest.raises(ValueError, match=name):
                self.ENV(**{name: value})


class ContextTestBase(EnvTestBase):
    def test_random_contexts_come_from_the_seed(self):
        first = self.make(3, seed=4).reset()["context"]
        torch.testing.assert_close(first, self.make(3, seed=4).reset()["context"], rtol=0, atol=0)
        env = self.make(3, seed=4)
        np.testing.assert_allclose(env.reset()["context"], draw_contexts(env.task, 3, 4), rtol=0, atol=1e-7)
        assert (env.reset()["context"] != first).any(-1).all()
        env.set_seed(9)
        again = env.reset()["context"]
        env.set_seed(9)
        torch.testing.assert_close(env.reset()["context"], again, rtol=0, atol=0)

    def test_wrong_contexts_are_named(self):
        env, contexts = self.make(2), evaluation_contexts(self.make().task)[:2]
        with pytest.raises(ValueError, match="wanted 2, got 1"):
            env.reset(contexts=contexts[:1])
        with pytest.raises(TypeError, match="'context'"):  # a misspelt keyword must not fall back to random contexts
            env.reset(context=contexts)
        contexts[1, -1, 0] = 9.0
        with pytest.raises(ValueError, match=f"context 1 puts '{env.task.objects[-1]}' at .*outside its region"):
            env.reset(contexts=contexts)
