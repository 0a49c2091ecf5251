# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that simulated actions match later execution and leave the environment unchanged."""

import copy
import multiprocessing
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from torchrl_koap.envs import AligningEnv, AvoidingEnv, StackingEnv
from torchrl_koap.envs.contexts import evaluation_contexts


def started(make, task, steps, **options):
    contexts = None if task == "avoiding" else evaluation_contexts(task)[:2]
    env = make(2, dtype=torch.float64, **options)
    data = env.reset() if contexts is None else env.reset(contexts=contexts)
    torch.manual_seed(0)
    for _ in range(steps):
        data = env.step(data.set("action", 0.3 * env.action_spec.rand()))["next"]
    return env, data


@pytest.mark.parametrize(
    ("make", "task"), [(AvoidingEnv, "avoiding"), (AligningEnv, "aligning"), (StackingEnv, "stacking")]
)
def test_simulated_actions_come_true(make, task):
    env, data = started(make, task, 4)
    actions = 0.3 * torch.stack([env.action_spec.rand() for _ in range(3)], 1)  # [2, 3, act]
    before = [env.get_state(row) for row in range(2)]
    simulated = env.simulate_actions(np.stack([np.zeros(actions.shape), actions.numpy()]), np.arange(2))[1]
    for row, state in enumerate(before):
        after = env.get_state(row)
        assert all(np.array_equal(state["simulation"][name], after["simulation"][name]) for name in state["simulation"])
        assert all(np.array_equal(state[name], after[name]) for name in state if name != "simulation")
    seen = []
    for step in range(4):
        data = env.step(data.set("action", actions[:, min(step, 2)]))["next"]
        seen.append(data["observation"].numpy())
    hidden = env.task.command_columns.stop if env.task.command else 0  # the command is not a step late
    assert np.allclose(simulated[..., hidden:], np.stack(seen[1:], 1)[..., hidden:], atol=1e-12)


def test_some_environments_alone():
    env, _ = started(AvoidingEnv, "avoiding", 2)
    both = env.simulate_actions(np.full((1, 2, 2, 2), 0.01), np.arange(2))
    assert np.array_equal(env.simulate_actions(np.full((1, 1, 2, 2), 0.01), np.array([1]))[:, 0], both[:, 1])


def test_episodes_that_are_over():
    env, data = started(AvoidingEnv, "avoiding", 0, max_steps=1)
    assert env.over.tolist() == [False, False]
    env.step(data.set("action", torch.zeros(2, 2, dtype=torch.float64)))
    assert env.over.tolist() == [True, True]


def test_copies_and_what_is_unpickled_have_simulations_of_their_own(tmp_path):
    env, data = started(AvoidingEnv, "avoiding", 0)
    env.render()
    data = data.set("action", torch.full((2, 2), 0.01, dtype=torch.float64))
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    before = env.sims.data[0].time
    steps = [other.step(data.clone()) for other in (copy.deepcopy(env), pickle.loads((tmp_path / "env").read_bytes()))]
    assert env.sims.data[0].time == before
    wanted = env.step(data.clone())["next", "observation"]
    assert all(torch.equal(step["next", "observation"], wanted) for step in steps)
    load = f"import pickle; print(pickle.load(open({str(tmp_path / 'env')!r}, 'rb')).rollout(3).shape)"
    assert "[2, 3]" in subprocess.run([sys.executable, "-c", load], capture_output=True, text=True, check=True).stdout


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are forked on Linux")
def test_a_forked_environment_has_threads_of_its_own():
    env = AvoidingEnv(2, num_threads=2)
    env.rollout(1)
    forked = multiprocessing.get_context("fork").Process(target=env.rollout, args=(1,))
    forked.start()
    forked.join(20)
    forked.kill()
    assert forked.exitcode == 0
    env.close()


def test_a_simulation_that_diverges_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    env, data = started(AvoidingEnv, "avoiding", 0)
    env.sims.data[1].qvel[:] = np.nan
    with pytest.raises(RuntimeError, match="the simulation of environment 1 became unstable"):
        env.step(data.set("action", torch.zeros(2, 2, dtype=torch.float64)))
