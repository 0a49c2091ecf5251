# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that kinematics in torch equal those of the simulator."""

import numpy as np
import pytest
import torch

from torchrl_koap.envs.mujoco.kinematics import Q_MAX, Q_MIN, forward_kinematics
from torchrl_koap.tasks.panda_kinematics import tool_position


def test_equal_to_the_controller_s_own():
    joints = np.random.default_rng(0).uniform(Q_MIN, Q_MAX, (50, 7))
    axes, origins, tool, quaternion = np.empty((8, 3, 3)), np.empty((8, 3)), np.empty(3), np.empty(4)
    found = tool_position(torch.from_numpy(joints))
    for row, place in zip(joints, found, strict=True):
        forward_kinematics(row, axes, origins, tool, quaternion)
        np.testing.assert_allclose(place, tool, rtol=0, atol=1e-12)


def test_gradients_are_those_of_a_difference():
    joints = torch.zeros(7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(tool_position, (joints + 0.3,))
    assert tool_position(torch.zeros(2, 3, 7)).shape == (2, 3, 3)
    with pytest.raises(ValueError, match="seven joints are needed"):
        tool_position(torch.zeros(6))
