# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests AvoidingEnv: parity with recordings of the original, order of events, invalid actions."""

import json
import pickle

import numpy as np
import pytest
import torch
from env_test_base import (
    HUMAN,
    OTHER_MUJOCO,
    WHY_OTHER,
    EnvTestBase,
    act,
    assert_starts_as_recorded,
    recordings_of,
    replay,
    start_recorded,
)
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import StepCounter

from torchrl_koap.envs.avoiding import AvoidingEnv

needs_human = pytest.mark.skipif(not HUMAN.exists(), reason=f"no human demonstrations at {HUMAN}")

# head on into the cylinder of the first row
INTO_ROW_1 = torch.tensor([-0.0010, 0.010], dtype=torch.float64)
# over y = 0.35 past every cylinder, on the side of large x
AROUND = torch.tensor([(0.012, 0.004)] * 18 + [(0.0, 0.012)] * 60, dtype=torch.float64)


class TestAvoidingEnv(EnvTestBase):
    ENV = AvoidingEnv
    PUSH = INTO_ROW_1.tolist()
    STEPS = 40  # one of them touches a cylinder by then


@pytest.mark.parametrize("start", ["reset", "recorded state"])
def test_parity_with_the_original(start):
    recorded = recordings_of("avoiding")
    env = AvoidingEnv(4, max_steps=1000, dtype=torch.float64)
    first = env.reset()
    if start == "recorded state":
        start_recorded(env, recorded)
    assert_starts_as_recorded(env, recorded)
    for i in range(4):
        np.testing.assert_allclose(first["observation"][i, 2:], recorded[f"ep{i}_init_obs"], rtol=0, atol=1e-7)

    def check(i, k, out, where):
        deviation = np.abs(env.sims.tcp_position[i] - recorded[f"ep{i}_c_pos"][k]).max()
        assert deviation < 1e-9, where  # 1e-6 mm, whole episodes, the collision included
        observed = np.abs(out["observation"][i, 2:].numpy() - recorded[f"ep{i}_obs_step"][k]).max()
        assert observed < 1e-7, where  # recorded in float32
        assert out["success"][i].item() == bool(recorded[f"ep{i}_success"][k]), where
        assert out["done"][i].item() == bool(recorded[f"ep{i}_done"][k]), where
        assert out["mode"][i].int().tolist() == recorded[f"ep{i}_mode"][k].tolist(), where
        contacts = env.obstacle_contacts()[i].astype(int).tolist()
        assert contacts == recorded[f"ep{i}_obstacle_contact"][k].tolist(), where

    replay(env, recorded, check, 2)


@needs_human
@pytest.mark.skipif(OTHER_MUJOCO, reason=WHY_OTHER)
def test_human_demonstrations_replay_to_their_own_logs():
    files = sorted(HUMAN.glob("*.pkl"))
    logs = [pickle.loads(path.read_bytes())["robot"] for path in files]
    modes = json.loads((HUMAN / "modes.json").read_text())
    lengths = np.array([len(log["c_pos"]) for log in logs])
    env = AvoidingEnv(len(files), num_threads=2, max_steps=1000, dtype=torch.float64)
    env.reset()
    deviation = {}
    for k in range(lengths.max()):
        targets = np.stack([log["des_c_pos"][min(k, len(log["c_pos"]) - 1), :2] for log in logs])
        out = act(env, torch.as_tensor(targets - env.commands[:, :2]), lengths > k)
        row, _ = env.raw_log()
        for i in np.flatnonzero(lengths > k):
            for name, value in row.items():
                deviation.setdefault(name, np.zeros(len(files)))
                deviation[name][i] = max(deviation[name][i], np.abs(value[i] - logs[i][name][k]).max())
    # In two of the 24 the rod grazes the table; a change of 1e-11 m before it moves what follows by up to 0.02 mm.
    assert np.sort(deviation["c_pos"])[-3] < 1e-10 and deviation["c_pos"].max() < 1e-4
    assert np.median(deviation["j_pos"]) < 1e-9 and np.median(deviation["gripper_width"]) < 1e-10
    assert deviation["des_j_pos"].max() <= 1e-9
    assert [flags.int().tolist() for flags in out["mode"]] == [modes[path.name] for path in files]
    assert sorted(env.task.modes.index_of(out["mode"]).tolist()) == list(range(24))


def test_reset_observation_and_latency_of_one_step():
    env = AvoidingEnv(1, dtype=torch.float64)
    first = env.reset()["observation"][0]
    torch.testing.assert_close(first[:2], first[2:], rtol=0, atol=0)
    torch.testing.assert_close(first[:2], torch.tensor([0.524928, -0.279737], dtype=torch.float64), rtol=0, atol=1e-6)
    step = torch.tensor([0.020, 0.010], dtype=torch.float64)  # beyond the human range: executed unclipped
    before = torch.as_tensor(env.sims.tcp_position[0, :2])
    for k in range(1, 6):
        seen = act(env, step)["observation"][0]
        torch.testing.assert_close(seen[:2], first[:2] + k * step, rtol=0, atol=1e-12)
        torch.testing.assert_close(seen[2:], before, rtol=0, atol=0)
        before = torch.as_tensor(env.sims.tcp_position[0, :2])


def test_command_is_held_in_float64():
    env = AvoidingEnv(1)
    env.reset()
    start = env.commands[0, :2]
    tiny = np.float32(1e-9)  # far below float32's resolution at 0.5
    for _ in range(20):
        act(env, torch.full((1, 2), float(tiny)))
    np.testing.assert_allclose(env.commands[0, :2] - start, 20 * tiny, rtol=1e-6)


def test_collisions_are_seen_in_every_environment_one_step_late():
    env = AvoidingEnv(3, dtype=torch.float64)
    env.reset()
    touched = None
    for k in range(60):
        out = act(env, INTO_ROW_1)
        if touched is None:
            assert not out["done"].any()
            if env.obstacle_contacts().any():
                touched = k
        else:
            break
    assert k == touched + 1
    assert env.obstacle_contacts()[:, 0].all()
    assert out["collision"].all() and out["terminated"].all() and out["done"].all()
    assert not out["success"].any() and not out["truncated"].any() and not out["reward"].any()


def test_success_one_step_late_and_latched():
    env = AvoidingEnv(1, dtype=torch.float64)
    env.reset()
    crossed = None
    for k, action in enumerate(AROUND):
        out = act(env, action)
        if crossed is not None:
            break
        assert not out["success"].item() and not out["done"].item()
        if env.sims.tcp_position[0, 1] > 0.35:
            crossed = k
    assert k == crossed + 1
    assert out["success"].item() and out["terminated"].item() and out["reward"].item() == 1.0
    for _ in range(20):
        out = act(env, torch.tensor([0.0, -0.012]))
    assert env.sims.tcp_position[0, 1] < 0.35 and out["success"].item() and not out["collision"].item()


def test_crossing_while_touching_is_a_success(monkeypatch):
    env = AvoidingEnv(2, max_steps=2, dtype=torch.float64)
    env.reset()
    both, touching = np.array([True, False]), np.array([True, True])
    monkeypatch.setattr(env, "_check", lambda rows: (both[rows], touching[rows]))
    act(env, torch.zeros(2))
    monkeypatch.setattr(env, "_check", lambda rows: (np.ones(2, bool)[rows], np.zeros(2, bool)[rows]))
    for _ in range(2):  # the outcome of the second environment is not changed by crossing afterwards
        out = act(env, torch.zeros(2))
        assert out["success"][:, 0].tolist() == [True, False]
        assert out["collision"][:, 0].tolist() == [False, True]
        assert out["terminated"].all() and out["truncated"].all()  # both, in the last step
    assert out["reward"].tolist() == [[1.0], [0.0]]
    assert not act(env, torch.zeros(2), mask=[False, True])["reward"].any()  # of the steps of this call


def test_mode_flags_are_set_once():
    env = AvoidingEnv(1)
    env.reset()
    x, y = 0.0, 0.0
    env.sims._tcp_views = [np.array([x, y, 0.12])]
    passages = [
        ((0.45, -0.14), []),
        ((0.45, -0.13), [0]),
        ((0.55, -0.07), [0]),
        ((0.575, 0.05), [0]),
        ((0.50, 0.06), [0, 3]),
        ((0.40, 0.11), [0, 3]),
        ((0.35, 0.259), [0, 3]),
        ((0.35, 0.26), [0, 3]),
        ((0.65, 0.27), [0, 3, 8]),
        ((0.30, 0.28), [0, 3, 8]),
    ]
    for (x, y), flags in passages:
        env.sims._tcp_views[0][:2] = x, y
        env._update_mode(np.array([0]))
        assert np.flatnonzero(env._mode[0]).tolist() == flags, (x, y)


def test_collector_restarts_environments_that_end_at_different_times():
    actions = torch.stack([INTO_ROW_1, 1.3 * INTO_ROW_1, 0 * INTO_ROW_1]).float()
    env = TransformedEnv(AvoidingEnv(3, max_steps=37), StepCounter())
    policy = TensorDictModule(lambda _: actions, ["observation"], ["action"])
    collector = Collector(
        env, policy, frames_per_batch=3 * 90, total_frames=3 * 90, auto_register_policy_transforms=False
    )
    data = next(iter(collector))
    collector.shutdown()
    ends = [row.nonzero().flatten().tolist() for row in data["next", "done"][..., 0]]
    assert ends[0] != ends[1] and len(ends[0]) >= 2 and ends[2] == [36, 73]
    start = AvoidingEnv(1).reset()["observation"][0]
    for row, row_ends in enumerate(ends):
        for end in row_ends:
            torch.testing.assert_close(data["observation"][row, end + 1], start, rtol=0, atol=0)
            assert data["step_count"][row, end + 1].item() == 0
    # every episode of an environment repeats the first one bit for bit
    length = ends[0][0] + 1
    first, second = data["observation"][0, :length], data["observation"][0, length : 2 * length]
    torch.testing.assert_close(first, second, rtol=0, atol=0)
