# This source code is licensed under the MIT license found in the LICENSE file.
"""The simulated player for Aligning: it succeeds in the asked mode, repeats itself from its seed, moves like a hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.envs import AligningEnv
from torchrl_koap.envs.contexts import draw_contexts, evaluation_contexts
from torchrl_koap.envs.experts.aligning import CONTACTS, FULL_PUSH, SURGE, AligningExpert
from torchrl_koap.evaluation.statistics import wilson_interval


def play(modes, contexts, seeds, steps=400):
    """Final leaves, actions [T, n, 3], tilt of the tray [T, n] (rad), steps and players of one episode each."""
    count = len(modes)
    env, expert = AligningEnv(count, dtype=torch.float64), AligningExpert(modes, contexts, seeds)
    out = env.reset(contexts=contexts)
    alive, actions, tilt, lengths = np.ones(count, dtype=bool), [], [], np.full(count, steps)
    for step in range(steps):
        observation = out["observation"].numpy()
        actions.append(expert.act(observation))
        tilt.append(np.where(alive, 2 * np.arcsin(np.minimum(np.linalg.norm(observation[:, 10:12], axis=1), 1)), 0))
        action = torch.from_numpy(np.where(alive[:, None], actions[-1], 0.0))
        out = env.step(TensorDict({"action": action, "_step": torch.as_tensor(alive)[:, None]}, [count]))["next"]
        ended = alive & out["done"][:, 0].numpy()
        lengths[ended] = step + 1
        alive &= ~ended
        if not alive.any():
            break
    return out, np.stack(actions), np.stack(tilt), lengths


def solved(out, modes):
    return (out["success"][:, 0] & (out["mode"][:, 0] == torch.as_tensor(modes))).numpy()


def test_most_first_attempts_succeed_in_the_asked_mode():
    modes = [0, 1] * 6
    out, actions, tilt, lengths = play(modes, draw_contexts("aligning", 12, 3), [(5, index) for index in range(12)])
    good = solved(out, modes)
    assert good.sum() >= 9
    assert 80 < np.median(lengths[good]) < 250
    assert np.degrees(tilt.max(0)[good]).max() < 10
    for index, length in enumerate(lengths):
        own = actions[:length, index]
        assert np.abs(own).max() < 1.03 * FULL_PUSH + 0.0015  # what a hand's wobble adds
        assert np.abs(np.diff(own, axis=0)).max() < SURGE + 0.0015


def test_an_episode_depends_on_its_seed_alone():
    contexts = evaluation_contexts("aligning", 3)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    _, batch, _, _ = play([0, 1, 0], contexts, [1, (2, 5), (2, 6)], 60)
    for row, (mode, seed) in enumerate(((0, 1), (1, (2, 5)), (0, (2, 6)))):
        _, alone, _, _ = play([mode], contexts[row : row + 1], [seed], 60)
        np.testing.assert_array_equal(alone[:, 0], batch[:, row])
    _, other, _, _ = play([0], contexts[:1], [7], 60)
    assert np.abs(other[:, 0] - batch[:, 0]).max() > 1e-3
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_contacts_lie_at_the_walls():
    inside, outside = CONTACTS
    assert np.abs(inside[:, 4:6]).max() == pytest.approx(0.035) and (np.hypot(*inside[:, 4:6].T) < 0.051).all()
    np.testing.assert_allclose(np.abs(outside[:, 4:6]).max(1), 0.065)
    for contact in outside:  # the rod pushes towards the wall, from a radius away
        force = np.array([math.cos(contact[2]), math.sin(contact[2])])
        np.testing.assert_allclose(contact[4:6] + 0.01 * force, contact[:2], atol=1e-15)


def observed(tray, tcp, target=(0.5, 0.3, 0.0)):
    def pose(x, y, yaw, z):
        return [x, y, z, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]

    return np.array([[*tcp, *tcp, *pose(*tray, -0.0091), *pose(*target, 0.0)]])


def test_it_lets_go_when_the_tray_lies_there():
    expert = AligningExpert([0], np.array([[(0.5, -0.2, 0.0), (0.5, 0.3, 0.0)]]), [0])
    for _ in range(12):
        moving = expert.act(observed((0.5, -0.2, 0.0), (0.525, -0.35, 0.25)))
    assert np.abs(moving).max() > 0.005 and not expert.finished.any()
    steps = 0
    while not expert.finished.all():
        last = expert.act(observed((0.51, 0.29, math.radians(8)), (0.5, 0.3, 0.15)))
        steps += 1
        assert steps < 12
    assert steps >= 3 and np.abs(last).max() < 0.0025


def test_bad_input():
    contexts = draw_contexts("aligning", 2, 0)
    with pytest.raises(ValueError, match="got 1, 2 and 2"):
        AligningExpert([0], contexts, [0, 1])
    with pytest.raises(ValueError, match=r"got \[2\]"):
        AligningExpert([0, 2], contexts, [0, 1])
    with pytest.raises(ValueError, match=r"\[C, 2, 3\]"):
        AligningExpert([0, 1], contexts[..., :2], [0, 1])
    with pytest.raises(ValueError, match=r"shape \[2, 20\], got \[2, 17\]"):
        AligningExpert([0, 1], contexts, [0, 1]).act(np.zeros((2, 17)))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("mode", [0, 1])
@pytest.mark.parametrize("table", ["evaluation", "drawn"])
def test_nine_of_ten_first_attempts_succeed(mode, table):
    contexts = evaluation_contexts("aligning") if table == "evaluation" else draw_contexts("aligning", 100, 11)
    count = len(contexts)
    out, _, _, lengths = play([mode] * count, contexts, [(mode, index) for index in range(count)])
    good = solved(out, [mode] * count)
    assert good.mean() >= 0.9, wilson_interval(int(good.sum()), count)
    assert 100 < np.median(lengths[good]) < 250
