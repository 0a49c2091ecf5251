# This source code is licensed under the MIT license found in the LICENSE file.
"""Modes in words follow the numbering of the environments."""

from __future__ import annotations

import itertools

import pytest
import torch

from torchrl_koap.tasks import TASKS


@pytest.mark.parametrize("mode", range(24))
def test_mode_names_follow_the_flags(mode):
    envs = pytest.importorskip("torchrl_koap.envs.avoiding")
    row1, row2, row3 = TASKS["avoiding"].modes.name_of(mode).split(", ")
    flags = torch.zeros(9, dtype=torch.int64)
    flags[("left", "right").index(row1)] = 1
    flags[2 + ("left", "middle", "right").index(row2)] = 1
    flags[5 + int(row3[-1]) - 1] = 1
    assert envs.mode_index(flags) == mode


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task.modes.choices])
def test_every_task_has_as_many_names_as_modes(task):
    modes, number = TASKS[task].modes, TASKS[task].num_modes
    assert len({modes.name_of(mode) for mode in range(number)}) == number and modes.name_of(number) == "no mode"


@pytest.mark.parametrize(("task", "boxes"), [("sorting", 4), ("sorting_2", 2), ("sorting_6", 6), ("po_sorting", 4)])
def test_names_of_sorting(task, boxes):
    sorting = pytest.importorskip("torchrl_koap.envs.sorting")
    for mode in range(TASKS[task].num_modes):
        colours = ("red, blue".split(", ")[colour] for colour in sorting.mode_colours(mode, boxes))
        assert TASKS[task].modes.name_of(mode) == ", ".join(colours)


def test_names_of_stacking_and_aligning():
    registry = pytest.importorskip("torchrl_koap.envs.registry")
    letters = ("red", "green", "blue")
    for order in itertools.permutations(range(3)):
        mode = int(registry.mode_index_of("stacking")(torch.tensor(order)))
        assert TASKS["stacking"].modes.name_of(mode) == ", ".join(letters[letter] for letter in order)
        first = int(registry.mode_index_of("stacking_1")(torch.tensor(order)))
        assert TASKS["stacking_1"].modes.name_of(first) == letters[order[0]]
    assert [TASKS["aligning"].modes.name_of(mode) for mode in (0, 1)] == ["inside", "outside"]
