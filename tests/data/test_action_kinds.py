# This source code is licensed under the MIT license found in the LICENSE file.
"""Actions of another kind than declared are told of, and those of the declared kind are not."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_koap.data import make_demonstrations
from torchrl_koap.data.action_kinds import kind_warnings

NOISE = np.random.default_rng(0).normal(size=(4, 60, 3))
PATHS = [noise.cumsum(0) for noise in NOISE]
DELTAS = [np.diff(path[:, :2], axis=0) for path in PATHS]
TARGETS = [path[1:, :2] + 0.1 * noise[1:, :2] for path, noise in zip(PATHS, NOISE[::-1], strict=True)]
JOINTS = ("shoulder.pos", "elbow pos", "cup")


def warnings(states, actions, names=JOINTS, acting=("a", "b"), **described):
    described |= {"state_names": names, "action_names": acting, "control_hz": 10}
    return list(kind_warnings(*make_demonstrations(states, actions, **described)))


def test_targets_that_are_declared_as_changes():
    (said,) = warnings(PATHS, TARGETS)
    assert "of shoulder.pos, elbow pos on average: they look like absolute targets" in said
    assert said.endswith("again with --action-kind absolute --targets shoulder.pos 'elbow pos'")
    distance = float(said.split()[3])
    assert 0.05 < distance < 0.15
    assert not warnings(PATHS, TARGETS, action_kind="absolute", targets=JOINTS[:2])


def test_far_numbers_are_compared_as_the_robot_reports_them():
    far = [path + 4e6 for path in PATHS]
    assert not warnings(far, [frames[1:, :2] for frames in far], action_kind="absolute", targets=JOINTS[:2])


def test_a_name_that_is_the_same_allows_for_targets_that_lie_farther_away():
    paths = [path + 50 for path in PATHS]
    ahead = [frames[1:, :2] + 3 * noise[1:, :2] for frames, noise in zip(paths, NOISE[::-1], strict=True)]
    assert not warnings(paths, ahead)
    assert "absolute --targets" in warnings(paths, ahead, acting=JOINTS[:2])[0]


def test_one_absolute_column_beside_changes():
    mixed = [np.column_stack([steps[:, 0], aims[:, 1]]) for steps, aims in zip(DELTAS, TARGETS, strict=True)]
    assert warnings(PATHS, mixed)[0].endswith("--action-kind delta absolute")
    assert not warnings(PATHS, mixed, action_kind=["delta", "absolute"])


@pytest.mark.parametrize("scale", [1, 10], ids=["change", "velocity"])
def test_changes(scale):
    steps = [scale * step for step in DELTAS]
    assert not warnings(PATHS, steps)
    assert not warnings(PATHS, steps, acting=JOINTS[:2])
    said = warnings(PATHS, steps, action_kind="absolute", targets=JOINTS[:2])
    assert len(said) == 2 and all("convert again with --action-kind delta" in each for each in said)


def test_velocities_that_are_also_in_the_state_are_no_targets():
    moving = [np.column_stack([path[1:, 0], 10 * step]) for path, step in zip(PATHS, DELTAS, strict=True)]
    steps = [frames[1:, 1:2] for frames in moving]
    assert not warnings(moving, steps, names=("q", "dq", "dp"), acting=("u",))


def test_few_labels_say_nothing():
    assert not warnings([PATHS[0][:10]], [TARGETS[0][:9]])
