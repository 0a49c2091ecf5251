# This source code is licensed under the MIT license found in the LICENSE file.
"""What the planner is told about tool and objects: right numbers, unchanged when the scene is moved and turned."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.modules import StatePlanner, TemporalUnet
from torchrl_koap.modules.planning.relative_positions import (
    NEAR,
    RelativePositionFeatures,
)
from torchrl_koap.tasks import TASKS, get_task

TOOL, BOX, YAW, GOAL_YAW = slice(0, 3), slice(3, 5), slice(5, 7), slice(7, 9)


def state(tool, box, yaw, goal_yaw=0.0):
    angles = [f(angle) for angle in (yaw, goal_yaw) for f in (math.cos, math.sin)]
    return torch.tensor([[*tool, *box, *angles]], dtype=torch.float64)


def test_a_position_seen_from_a_turned_box_by_hand():
    relations = RelativePositionFeatures([(TOOL, BOX, YAW, GOAL_YAW)])
    found = relations(state((0.5, 0.31, 0.2), (0.5, 0.3), math.pi / 2, goal_yaw=math.pi / 2 + 0.3))
    gap = torch.tensor([0.01, 0.0, 0.2], dtype=torch.float64)  # ahead of the box, which looks along y; height as it is
    wanted = torch.cat([torch.tensor([math.cos(0.3), math.sin(0.3)], dtype=torch.float64), gap])
    wanted = torch.cat([wanted, *(torch.tanh(gap / near) for near in NEAR)])
    torch.testing.assert_close(found, wanted)
    assert relations.num_features == len(found) == 11


def test_moving_and_turning_everything_changes_nothing():
    relations = RelativePositionFeatures([(slice(0, 2), BOX, YAW, GOAL_YAW)])
    angle, shift = 0.7, torch.tensor([0.2, -0.1], dtype=torch.float64)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    before = state((0.5, 0.31, 0.2), (0.45, 0.2), 0.4, 1.1)
    after = before.clone()
    for part in (slice(0, 2), BOX):
        after[:, part] = before[:, part] @ turn.T + shift
    for part in (YAW, GOAL_YAW):
        after[:, part] = before[:, part] @ turn.T
    torch.testing.assert_close(relations(before), relations(after))


def test_only_the_present_frame_counts_and_batches_are_kept():
    relations = RelativePositionFeatures([(TOOL, BOX)])
    history = torch.randn(2, 3, 4, 9)
    found = relations(history)
    assert found.shape == (2, 3, relations.num_features)
    history[..., :3, :] = torch.nan
    assert torch.equal(relations(history), found)


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.relative_positions])
def test_every_task_s_relations_fit_its_state_and_travel_with_the_planner(name):
    task = get_task(name)
    features = RelativePositionFeatures(task.relative_columns())
    width = 2 * task.state_dim + features.num_features
    planner = StatePlanner(
        TemporalUnet(task.state_dim, width, channels=(8, 16)), state_dim=task.state_dim, features=features
    )
    windows = torch.randn(50, 16, task.state_dim)
    planner.fit_normalizers(windows)
    assert planner.encode_history(windows[:5, :2]).shape == (5, width)
    assert planner.sample(windows[:5, :2]).shape == (5, 14, task.state_dim)


def test_avoiding_has_none():
    assert not get_task("avoiding").relative_columns()
