# This source code is licensed under the MIT license found in the LICENSE file.
"""Random play: labelled motions of full length that keep within bounds."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_koap.envs.experts import random_play
from torchrl_koap.envs.experts.random_play import record_random_play
from torchrl_koap.tasks.avoiding import OBSTACLES

BOUNDS = [(0.35, 0.65), (-0.28, -0.18)]  # m, in front of the first cylinder of Avoiding


def test_actions_are_the_changes_of_the_command_and_every_one_has_a_label():
    play = record_random_play("avoiding", 3, steps=25, push=0.004, bounds=BOUNDS)
    assert play.batch_size == (75,) and play["episode"].bincount().tolist() == [25, 25, 25]
    assert play["has_action"].all()
    changed = play["next", "observation"][:, :2] - play["observation"][:, :2]
    torch.testing.assert_close(changed, play["action"], atol=1e-6, rtol=0)


def test_the_tool_is_turned_back_behind_a_bound():
    kept = record_random_play("avoiding", 4, steps=150, push=0.004, bounds=BOUNDS)["observation"]
    reach = 0.06  # m that a tool in motion still goes on
    for column, (low, high) in zip((2, 3), BOUNDS, strict=True):
        assert kept[:, column].min() > low - reach and kept[:, column].max() < high + reach
    assert kept[:, 2].std() > 0.03  # it does move about


def test_motions_do_not_depend_on_how_many_are_played_and_do_on_the_seed():
    three, two = (record_random_play("avoiding", count, steps=20, push=0.004, bounds=BOUNDS) for count in (3, 2))
    other = record_random_play("avoiding", 2, steps=20, push=0.004, bounds=BOUNDS, seed=1)
    torch.testing.assert_close(three["action"][:40], two["action"])
    assert (other["action"] - two["action"]).abs().mean() > 1e-3


def test_pushes_have_the_size_and_the_memory_asked_for():
    wide = [(0.1, 0.9), (-0.6, -0.12)]
    play = record_random_play("avoiding", 8, steps=100, push=0.002, bounds=wide, memory=5)
    action = play["action"].reshape(8, 100, 2).numpy()
    assert 0.0016 < action.std() < 0.0024
    lagged = np.mean([np.corrcoef(one[5:, axis], one[:-5, axis])[0, 1] for one in action for axis in (0, 1)])
    assert 0.2 < lagged < 0.5  # 1/e


def test_a_motion_that_collides_is_played_again(monkeypatch):
    through, count = [(0.4, 0.6), (-0.2, 0.3)], 12  # cylinders stand there
    play = record_random_play("avoiding", count, steps=60, push=0.01, bounds=through)
    assert play["episode"].bincount().tolist() == [60] * count
    for _, x, y, radius, _ in OBSTACLES:
        assert (play["observation"][:, 2:] - torch.tensor([x, y])).norm(dim=1).min() > radius
    monkeypatch.setattr(random_play, "MAX_ATTEMPTS", 1)
    with pytest.raises(RuntimeError, match=r"ended before 60 steps in 1 attempts at motions \[.*\]"):
        record_random_play("avoiding", count, steps=60, push=0.01, bounds=through)


@pytest.mark.parametrize(
    ("task", "given", "message"),
    [
        ("stacking", {}, "8 actions change the position"),
        ("avoiding", {"bounds": [(0, 1)]}, r"bounds must be 2 pairs \(low, high\)"),
        ("avoiding", {"bounds": [(0, 1), (1, 0)]}, r"bounds must be 2 pairs \(low, high\)"),
        ("avoiding", {"push": 0.0}, "push must be positive, got 0.0"),
        ("avoiding", {"steps": 0}, "steps must be positive, got 0"),
        ("avoiding", {"trajectories": -1}, "trajectories must be positive, got -1"),
    ],
)
def test_what_cannot_be_played_is_refused_by_name(task, given, message):
    options = {"trajectories": 2, "steps": 10, "push": 0.004, "bounds": BOUNDS} | given
    with pytest.raises(ValueError, match=message):
        record_random_play(task, **options)
