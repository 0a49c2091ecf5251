# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests what is said of odd rollouts; the Gymnasium tests have limited commands and real environments."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import make_demonstrations
from torchrl_koap.evaluation.rollout_faults import stall_faults, standing_faults, start_faults


@pytest.fixture(scope="module")
def recorded():
    """Two joints that go to one goal from different starts."""
    random = np.random.default_rng(0)
    goal, starts = random.uniform(-1, 1, 2), random.uniform(-1, 1, (8, 2))
    states = [goal + 0.97 ** np.arange(80)[:, None] * (start - goal) for start in starts]
    return make_demonstrations(states, [np.diff(rows, axis=0) for rows in states], control_hz=100)


def rollout(observation):
    return TensorDict({"observation": observation}, [len(observation)])


def test_rollouts_of_noise_stand_still_and_short_ones_are_not_judged(recorded):
    data, noise = recorded[0], 0.01 * torch.randn(60, 2, generator=torch.Generator().manual_seed(0))
    gone = data["observation"][:79]
    failed = [rollout(seen) for seen in (gone[:1] + noise, gone, gone[:4])]
    (said,) = standing_faults(failed, data)
    assert said.startswith("1 of 3 failed rollouts get less than 0.2 times as far")
    assert standing_faults(failed[1:], data) == standing_faults([], data) == []
    assert standing_faults(failed, data[data["episode"] == 0][:5]) == []  # nor do short recordings judge


def test_rollouts_that_stop_on_their_way_for_longer_than_recordings_stall():
    way = np.linspace(0, 1, 60)[:, None] ** [1.1, 1.2]
    pause = np.concatenate([way[:30], way[30:31].repeat(8, 0), way[30:]])  # some demonstrations wait for 8 steps
    data, _ = make_demonstrations([way, pause], [np.diff(rows, axis=0) for rows in (way, pause)], control_hz=10)
    hovering = way[30] + 0.05 * np.sin(np.arange(90))[:, None]
    stalled, waits = np.concatenate([way[:30], hovering]), np.concatenate([way[:30], hovering[:15], way[30:]])
    (said,) = stall_faults([rollout(torch.tensor(rows)) for rows in (stalled, waits, way)], data)
    assert said.startswith("1 of 3 failed rollouts stall: they stay near one observation for 9")
    assert "(median), demonstrations for at most 1" in said
    assert stall_faults([rollout(torch.tensor(rows)) for rows in (waits, way)], data) == stall_faults([], data) == []


def test_a_column_that_starts_elsewhere_is_named(recorded):
    data, task = recorded
    offset = torch.tensor([0.0, 5.0])
    begun = [data["observation"][data["episode"] == number] for number in range(5)]
    (said,) = start_faults([rollout(rows + offset) for rows in begun], data, task)
    assert said.startswith(f"rollouts start where no recording does: {task.observation_names[1]} at 4.")
    assert start_faults([rollout(rows) for rows in begun], data, task) == []
    assert start_faults([rollout(rows + offset) for rows in begun[1:]], data, task) == [], "too few to compare"
