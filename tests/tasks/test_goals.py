# This source code is licensed under the MIT license found in the LICENSE file.
"""Goals judged on states follow the rules of the environments."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.tasks import aligning, get_task


def test_the_planar_tolerance_of_aligning_leaves_room_for_the_height():
    # the tray rests 9.1 mm below the target's centre
    wanted = math.sqrt(aligning.DISTANCE_TOLERANCE**2 - 0.0091**2)
    assert aligning.ALIGNED_DISTANCE == pytest.approx(wanted, abs=1e-4)


def aligned(distance, degrees):
    state = torch.zeros(11, dtype=torch.float64)
    angle = torch.tensor(math.radians(degrees), dtype=torch.float64)
    state[3:7] = torch.stack([torch.tensor(0.5 + distance), torch.tensor(0.25), angle.cos(), angle.sin()])
    state[7:11] = torch.tensor([0.5, 0.25, 1.0, 0.0])
    return get_task("aligning").goal_reached(state).item()


def test_aligning():
    assert aligned(0.015, 8.0) and not aligned(0.016, 0.0) and not aligned(0.0, 9.0) and not aligned(0.0, 180.0)


def test_sorting_needs_every_box_in_its_own_bin():
    task = get_task("sorting")
    good = torch.zeros(task.observation_dim)
    for box, place in {"red_1": 0.35, "red_2": 0.45, "blue_1": 0.6, "blue_2": 0.7}.items():
        good[task.observation[f"{box}_xy"]] = torch.tensor([place, 0.3])
    wrong, late = good.clone(), good.clone()
    wrong[task.observation["red_2_xy"]] = torch.tensor([0.6, 0.3])
    late[task.observation["blue_1_xy"]] = torch.tensor([0.6, 0.2])
    assert task.goal_reached(task.state_of(torch.stack([good, wrong, late]))).tolist() == [True, False, False]
    partial = get_task("po_sorting")
    assert partial.goal_reached(partial.state_of(torch.stack([good, wrong]))).tolist() == [True, False]


def test_stacking():
    task, single = get_task("stacking"), get_task("stacking_1")
    frames = torch.zeros(3, task.observation_dim)
    for index, box in enumerate(task.objects):
        part = task.observation[f"{box}_position"]
        frames[0, part] = torch.tensor([0.5, 0.2 + 0.01 * index, 0.01 + 0.06 * index])
        frames[1, part] = torch.tensor([0.5, 0.2, 0.01])  # all at one height
        frames[2, part] = torch.tensor([0.5, 0.2 + 0.05 * index, 0.01])
    assert task.goal_reached(task.state_of(frames)).tolist() == [True, False, False]
    assert single.goal_reached(single.state_of(frames)).tolist() == [True, True, True]
    assert not single.goal_reached(single.state_of(torch.zeros(1, 31))).item()


def test_states_of_another_size_are_refused():
    with pytest.raises(ValueError, match="a state of task 'aligning' has 11 columns, got 2"):
        get_task("aligning").goal_reached(torch.zeros(1, 2))
