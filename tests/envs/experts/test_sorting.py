# This source code is licensed under the MIT license found in the LICENSE file.
"""The simulated player of Sorting: brings the boxes in the asked order, repeats itself from its seed."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.envs import SortingEnv
from torchrl_koap.envs.contexts import draw_contexts, evaluation_contexts
from torchrl_koap.envs.experts.sorting import _STICK, SortingExpert
from torchrl_koap.envs.sorting import mode_index
from torchrl_koap.evaluation.statistics import wilson_interval

TASKS = {2: "sorting_2", 4: "sorting", 6: "sorting_6"}


def play(modes, contexts, seeds, num_boxes=4, steps=500):
    """Actions [T, n, 2], success [n], mode number [n] and control steps [n]; a finished episode stands still."""
    count = len(modes)
    env = SortingEnv(count, max_steps=steps, num_boxes=num_boxes, contexts=contexts, dtype=torch.float64)
    expert = SortingExpert(modes, contexts, seeds)
    out, actions, lengths = env.reset(), [], np.zeros(count, dtype=int)
    running = np.ones(count, dtype=bool)
    while running.any():
        actions.append(expert.act(out["observation"].numpy()))
        step = {"action": torch.from_numpy(actions[-1]), "_step": torch.from_numpy(running)[:, None]}
        out = env.step(TensorDict(step, [count]))["next"]
        lengths += running
        running &= ~(out["done"][:, 0].numpy() | expert.finished)
    return np.stack(actions), out["success"][:, 0].numpy(), mode_index(out["mode"]).numpy(), lengths


def test_first_attempts_arrive_in_the_asked_order():
    contexts = draw_contexts("sorting", 12, 21)
    modes = np.arange(12) % 6
    actions, success, took, lengths = play(modes, contexts, [(5, index) for index in range(12)])
    good = success & (took == modes)
    assert good.sum() >= 9
    assert set(took[good]) == set(range(6))
    assert np.abs(actions).max() <= _STICK
    assert np.median(lengths[good]) < 400


@pytest.mark.parametrize("num_boxes", [2, 6])
def test_other_numbers_of_boxes(num_boxes):
    modes = np.array([0, math.comb(num_boxes, num_boxes // 2) - 1])
    contexts = evaluation_contexts(TASKS[num_boxes], 2)
    _, success, took, _ = play(modes, contexts, [(0,), (1,)], num_boxes, steps=700)
    assert (success & (took == modes)).sum() >= 1


def test_an_episode_depends_on_its_seed_alone():
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002
    before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    contexts = np.repeat(draw_contexts("sorting", 1, 2), 3, axis=0)
    alone = play([4], contexts[:1], [(3, 1)], steps=60)[0]
    batch = play([1, 4, 4], contexts, [(5,), (3, 1), (3, 2)], steps=60)[0]
    np.testing.assert_array_equal(alone[:, 0], batch[:, 1])
    assert np.abs(alone[:, 0] - batch[:, 2]).max() > 1e-4
    assert torch.equal(torch.random.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


def observation(rod, boxes):
    flat = np.concatenate([np.asarray(boxes, dtype=float), np.zeros((len(boxes), 1))], axis=1).ravel()
    return np.concatenate([rod, rod, flat])[None]


def steady(expert, seen, steps=12):
    """What the player ends up doing if nothing that it sees changes."""
    for _ in range(steps):
        action = expert.act(seen)
    return action[0]


def test_it_pushes_a_box_that_lies_in_front_of_the_rod():
    contexts = np.zeros((1, 2, 3))
    expert = SortingExpert([0], contexts, [(0,)])
    action = steady(expert, observation((0.4, 0.04), [(0.4, 0.08), (0.62, 0.0)]))
    assert action[1] > 0.006 and abs(action[0]) < 0.003
    beside = SortingExpert([0], contexts, [(0,)])
    action = steady(beside, observation((0.4, 0.15), [(0.4, 0.08), (0.62, 0.0)]))
    assert np.abs(action[0]) > 0.003  # in front of the box: goes round it


def test_it_goes_round_a_box_of_the_other_colour():
    expert = SortingExpert([0], np.zeros((1, 2, 3)), [(0,)])
    rod, path = np.array([0.45, -0.25]), []
    for _ in range(60):
        seen = observation(rod, [(0.42, 0.08), (0.43, -0.1)])
        path.append(rod)
        rod = rod + expert.act(seen)[0]
        if np.linalg.norm(rod - (0.42, 0.08)) < 0.05:
            break
    gap = np.abs(np.array(path) - (0.43, -0.1)).max(1) - 0.03
    assert gap.min() > 0.01  # the radius of the rod
    assert np.linalg.norm(path[-1] - (0.42, 0.08)) < 0.07


def test_it_rests_after_the_last_box_and_after_a_lost_one():
    for places in ([(0.4, 0.3), (0.6, 0.3)], [(0.15, 0.0), (0.6, 0.0)]):
        expert = SortingExpert([0], np.zeros((1, 2, 3)), [(0,)])
        assert not expert.finished.any()
        action = steady(expert, observation((0.5, 0.1), places), 10)
        assert expert.finished.all() and np.abs(action).max() < 1e-4


def test_bad_input():
    contexts = draw_contexts("sorting", 2, 0)
    with pytest.raises(ValueError, match="2 modes.*1 seeds"):
        SortingExpert([0, 1], contexts, [(0,)])
    with pytest.raises(ValueError, match="at least one"):
        SortingExpert([], contexts[:0], [])
    with pytest.raises(ValueError, match="mode must be 0 to 5"):
        SortingExpert([0, 6], contexts, [(0,), (1,)])
    with pytest.raises(ValueError, match=r"shape \[2, 16\], got \[2, 4\]"):
        SortingExpert([0, 1], contexts, [(0,), (1,)]).act(np.zeros((2, 4)))
    with pytest.raises(ValueError, match="NaN, row 1"):
        SortingExpert([0, 1], contexts, [(0,), (1,)]).act(np.array([[0.5] * 16, [np.nan] * 16]))


@pytest.mark.slow
@pytest.mark.parametrize(("num_boxes", "least"), [(2, 0.9), (4, 0.9), (6, 0.75)])
def test_success_over_the_evaluation_contexts(num_boxes, least):
    contexts = evaluation_contexts(TASKS[num_boxes])
    modes = np.arange(len(contexts)) % math.comb(num_boxes, num_boxes // 2)
    seeds = [(9, index) for index in range(len(contexts))]
    _, success, took, _ = play(modes, contexts, seeds, num_boxes, steps=700)
    good = success & (took == modes)
    assert good.mean() >= least, wilson_interval(int(good.sum()), len(good))
    assert set(took[good]) == set(modes.tolist())
