# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations that are right in form and doubtful: each doubt names its trajectory."""

from __future__ import annotations

import shutil

import torch
from tiny_runs import koap, write_demonstrations

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.data.doubts import find_doubts

PATH = torch.arange(12.0).reshape(6, 2)
ACTIONS = torch.ones(5, 1)


def doubts(observations, actions, **options):
    return find_doubts(flatten_trajectories(observations, actions), units=["m", "m"], **options)


def test_sound_demonstrations_raise_none():
    assert doubts([PATH, PATH + 1, PATH], [ACTIONS, ACTIONS, 2 * ACTIONS]) == []


def test_each_doubt_is_said_once_and_names_its_trajectory():
    names = [f"{letter}.pkl" for letter in "abcdef"]
    paths = [PATH, PATH, PATH * 0, PATH * 1e37, PATH + 1, PATH + 2]
    actions = [ACTIONS, ACTIONS, ACTIONS, ACTIONS, 0 * ACTIONS, None]
    assert doubts(paths, actions, names=names, columns=["x", "y"]) == [
        "b.pkl repeats a.pkl: every step is the same",
        "c.pkl: nothing moves in its 5 steps",
        "d.pkl: x reaches 8e+37 m",
        "e.pkl: all 5 labelled actions are zero",
    ]


def test_columns_without_a_unit_are_not_judged():
    data = flatten_trajectories([PATH * 1e6, PATH], [ACTIONS, ACTIONS])
    assert find_doubts(data) == [] and len(find_doubts(data, units=["", "rad"])) == 1


def test_validate_names_the_files(tmp_path, capsys):
    folder = write_demonstrations(tmp_path / "data")
    assert koap("validate", folder) == 0
    assert "no problem found\n" in capsys.readouterr().out
    shutil.copy(folder / "env_000_00.pkl", folder / "env_900_00.pkl")
    assert koap("validate", folder) == 0
    said = capsys.readouterr().out
    assert "env_900_00.pkl repeats" in said and "no problem found, 1 doubt(s)" in said
