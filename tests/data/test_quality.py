# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations that are right in form and unlikely: each warning names its trajectory."""

from __future__ import annotations

import torch

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.data.quality import find_warnings

PATH = torch.arange(12.0).reshape(6, 2)
ACTIONS = torch.ones(5, 1)


def warnings(observations, actions, **options):
    return find_warnings(flatten_trajectories(observations, actions), units=["m", "m"], **options)


def test_sound_demonstrations_raise_none():
    assert warnings([PATH, PATH + 1, PATH], [ACTIONS, ACTIONS, 2 * ACTIONS]) == []


def test_each_warning_is_said_once_and_names_its_trajectory():
    names = [f"{letter}.pkl" for letter in "abcdef"]
    paths = [PATH, PATH, PATH * 0, PATH * 1e37, PATH + 1, PATH + 2]
    actions = [ACTIONS, ACTIONS, ACTIONS, ACTIONS, 0 * ACTIONS, None]
    assert warnings(paths, actions, names=names, columns=["x", "y"]) == [
        "b.pkl repeats a.pkl: every step is the same",
        "c.pkl: nothing moves in its 5 steps",
        "d.pkl: x reaches 8e+37 m",
        "e.pkl: all 5 labelled actions are zero",
    ]


def test_columns_without_a_unit_are_not_looked_at():
    data = flatten_trajectories([PATH * 1e6, PATH], [ACTIONS, ACTIONS])
    assert find_warnings(data) == [] and len(find_warnings(data, units=["", "rad"])) == 1


def test_columns_that_say_nothing_are_named():
    states = [torch.cat([path, path[:, :1], torch.full((6, 1), 3.0)], -1) for path in (PATH, PATH + 1)]
    data = flatten_trajectories(states, [ACTIONS, ACTIONS])
    data["state"] = data["observation"]
    assert find_warnings(data) == []
    assert find_warnings(data, seen=["x", "y", "again", "shelf"]) == [
        "columns 'x' and 'again' are the same in every step",
        "column 'shelf' is 3 in all 10 steps: it says nothing",
    ]
