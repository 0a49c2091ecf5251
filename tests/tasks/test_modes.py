# This source code is licensed under the MIT license found in the LICENSE file.
"""Modes in words and colours follow the numbering of the environments."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from matplotlib import colors as matplotlib_colors

from torchrl_koap.reports.mode_colors import mode_colors
from torchrl_koap.tasks import TASKS, modes


def test_mode_colors_are_distinct_with_hue_by_last_row_and_lightness_by_the_others():
    colors = mode_colors("avoiding")
    apart = np.abs(colors[:, None] - colors[None]).sum(-1) + 10 * np.eye(24)
    assert apart.min() > 0.08 and colors.min() >= 0 and colors.max() <= 1
    hue = matplotlib_colors.rgb_to_hsv(colors)[:, 0].reshape(6, 4)
    spread = np.abs(np.angle(np.exp(2j * np.pi * (hue - hue[2:3])))) / (2 * np.pi)
    assert spread.max() < 0.06  # a column keeps its hue
    between = np.abs(np.angle(np.exp(2j * np.pi * (hue[:, :, None] - hue[:, None])))) / (2 * np.pi)
    assert between[:, ~np.eye(4, dtype=bool)].min() > 0.08
    luminance = (colors @ [0.2126, 0.7152, 0.0722]).reshape(6, 4)
    assert (np.diff(luminance, axis=0) > 0).all()


@pytest.mark.parametrize("mode", range(24))
def test_mode_names_follow_the_flags(mode):
    envs = pytest.importorskip("torchrl_koap.envs.avoiding")
    row1, row2, row3 = modes.mode_name(mode, "avoiding").split(", ")
    flags = torch.zeros(9, dtype=torch.int64)
    flags[("left", "right").index(row1)] = 1
    flags[2 + ("left", "middle", "right").index(row2)] = 1
    flags[5 + int(row3[-1]) - 1] = 1
    assert envs.mode_index(flags) == mode


def test_modes_of_a_task_without_choices():
    assert mode_colors(None, 6).shape == (6, 3)
    assert modes.mode_name(3, None, 6) == "3"
    with pytest.raises(ValueError, match="wanted num_modes"):
        mode_colors("juggling")


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task.modes.choices])
def test_every_task_has_as_many_names_and_colors_as_modes(task):
    number = TASKS[task].num_modes
    assert math.prod(len(names) for _, names in modes.mode_choices(task)) == number
    names = {modes.mode_name(mode, task) for mode in range(number)}
    assert len(names) == number and modes.mode_name(number, task) == "no mode"
    colors = mode_colors(task)
    apart = np.abs(colors[:, None] - colors[None]).sum(-1) + 10 * np.eye(number)
    assert colors.shape == (number, 3) and apart.min() > 0.08


@pytest.mark.parametrize(("task", "boxes"), [("sorting", 4), ("sorting_2", 2), ("sorting_6", 6), ("po_sorting", 4)])
def test_names_of_sorting(task, boxes):
    sorting = pytest.importorskip("torchrl_koap.envs.sorting")
    for mode in range(TASKS[task].num_modes):
        colours = ("red, blue".split(", ")[colour] for colour in sorting.mode_colours(mode, boxes))
        assert modes.mode_name(mode, task) == ", ".join(colours)


def test_names_of_stacking_and_aligning():
    registry = pytest.importorskip("torchrl_koap.envs.registry")
    letters = ("red", "green", "blue")
    for order in itertools.permutations(range(3)):
        mode = int(registry.mode_index_of("stacking")(torch.tensor(order)))
        assert modes.mode_name(mode, "stacking") == ", ".join(letters[letter] for letter in order)
        first = int(registry.mode_index_of("stacking_1")(torch.tensor(order)))
        assert modes.mode_name(first, "stacking_1") == letters[order[0]]
    assert [modes.mode_name(mode, "aligning") for mode in (0, 1)] == ["inside", "outside"]
