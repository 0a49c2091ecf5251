# This source code is licensed under the MIT license found in the LICENSE file.
"""Recorded rollouts of Scooping, played again: where the spoon enters the bowl, and how high it is led through."""

import json

import numpy as np
import pytest
import torch

from torchrl_koap.tasks.scooping import EMBEDDING_DIM


@pytest.fixture
def strokes(benchmark_script):
    return benchmark_script("scooping_strokes")


def path(*heights):
    """A spoon at these heights, 1 cm further along x in every frame."""
    return np.stack([0.5 + 0.01 * np.arange(len(heights)), np.full(len(heights), 0.02), heights], 1)


def test_the_height_of_a_stroke_is_that_of_its_first_three_seconds_below_two_centimetres(strokes):
    down, up = np.full(10, 0.1), np.full(10, 0.15)
    first, second = np.linspace(0.006, 0.010, 20), np.full(40, 0.018)  # a second stroke comes later than three seconds
    assert strokes.stroke_height(np.concatenate([down, first, up, second])) == pytest.approx(0.008)
    assert strokes.stroke_height(down) is None


def test_a_stroke_enters_where_the_spoon_first_is_low(strokes):
    assert strokes.entry_of(path(0.1, 0.03, 0.019, 0.01)) == pytest.approx([0.52, 0.02])
    assert strokes.entry_of(path(0.1, 0.02)) is None


def test_usual_entries_are_those_of_the_robot_by_start(strokes):
    left, near = path(0.1, 0.1, 0.01), path(0.1, 0.01, 0.01, 0.01)
    left[:, 1], near[:, 0] = 0.22, near[:, 0] - 0.17
    hand = path(0.01, 0.01) + [0, 0.2, 0]
    spoon = np.concatenate([left, left + [0.02, 0, 0], near, hand])
    lengths = [3, 3, 4, 2]
    data = {
        "observation": torch.from_numpy(np.concatenate([np.zeros((12, EMBEDDING_DIM)), spoon], 1)),
        "episode": torch.arange(4).repeat_interleave(torch.tensor(lengths)),
        "has_action": torch.tensor([[True]] * 10 + [[False]] * 2),
    }
    usual = strokes.usual_entries(data)
    assert set(usual) == {"left", "near"}
    assert usual["left"] == pytest.approx([0.53, 0.22]) and usual["near"] == pytest.approx([0.34, 0.02])


def test_rollouts_are_played_again_and_one_that_ends_otherwise_is_refused(strokes, monkeypatch, tmp_path):
    env = strokes.ScoopingEnv(embed=False, seed=0)
    env.reset()
    actions = torch.from_numpy(env.sims.commands[0]).float().expand(1, 4, 7)  # stays where it is
    context = torch.tensor([[[0.5, 0.22, 0.0]]])
    rollouts = {"action": actions, "length": torch.tensor([4]), "outcome": torch.tensor([0]), "context": context}
    spoon, pieces = strokes.play_again(env, rollouts, 0)
    assert spoon.shape == (4, 3) and strokes.stroke_height(spoon[:, 2]) is None and pieces == 0
    with pytest.raises(RuntimeError, match="rollout 0 does not end as recorded"):
        strokes.play_again(env, rollouts | {"outcome": torch.tensor([1])}, 0)


def test_a_row_counts_rollouts_that_never_were_low_and_measures_the_others(strokes, monkeypatch, tmp_path):
    played = [(path(0.1, 0.012, 0.012), 0), (path(0.1, 0.1), 3), (path(0.1, 0.1, 0.1, 0.016), 0)]
    monkeypatch.setattr(strokes, "play_again", lambda env, rollouts, number: played[number])
    monkeypatch.setattr(strokes, "load_ted", lambda folder: None)
    monkeypatch.setattr(strokes, "usual_entries", lambda data: {"left": np.array([0.5, 0.02])})
    config = {"label_episodes": [0, 1], "dataset": "x/data_none_2", "method": "koap", "seed": 1}
    (tmp_path / "config.json").write_text(json.dumps(config))
    context = torch.tensor([[[0.5, 0.22, 0.0]]]).expand(3, -1, -1)
    monkeypatch.setattr(strokes, "load_file", lambda file: {"context": context, "outcome": torch.zeros(3)})
    (row,) = strokes.rows_of(tmp_path, None)
    cell = [2, "none", "koap", 1, "left", 0, 3]
    assert list(row.values()) == [*cell, "14.0", "2.8", "1.0", "20.0", "14.1"]
