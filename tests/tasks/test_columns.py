# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests state columns of observations, the layouts of all tasks, and angles on the unit circle."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_koap.tasks import TASKS, Columns, get_task
from torchrl_koap.tasks.columns import double_yaw, thousandths, yaw_of

PARTS = {"command": 2, "tool": 2, "box_xy": 2, "box_tan_yaw": 1}
TOY = {"name": "toy", "observation_parts": PARTS, "command": "command"}


@pytest.mark.parametrize("name", TASKS)
def test_columns_of_every_task(name):
    task = TASKS[name]
    for slices, width in ((task.observation, task.observation_dim), (task.state_slices, task.state_dim)):
        covered = [column for part in slices.values() for column in range(part.start, part.stop)]
        assert covered == list(range(width))  # no gap, no overlap, in order
    assert len(task.observation_names) == task.observation_dim and len(task.state_names) == task.state_dim
    assert set(task.hidden) < set(task.observation)


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.command is not None])
def test_no_state_shows_the_command(name):
    """Whatever the commanded columns hold, NaN included, the state is the same."""
    task = get_task(name)
    observation = torch.randn(5, task.observation_dim)
    hidden = observation.clone()
    hidden[:, task.observation[task.command]] = torch.nan
    assert torch.equal(task.state_of(observation), task.state_of(hidden))


def test_hidden_parts_are_no_state():
    columns = Columns(**TOY, hidden=("box_xy",))
    assert columns.state_columns == (2, 3, 6) and columns.observation_dim == 7


def test_columns_have_names_and_units():
    columns = Columns(**TOY, state={"tool": "plain", "box_tan_yaw": "tan_yaw"}, observation_units=("m",) * 6 + ("",))
    assert columns.observation_names[:2] == ("command_0", "command_1")
    assert columns.observation_names[-1] == "box_tan_yaw"
    assert columns.state_names == ("tool_0", "tool_1", "box_tan_yaw_cos_2yaw", "box_tan_yaw_sin_2yaw")
    assert columns.state_units == ("m", "m", "", "") and columns.state_dim == 4
    named = Columns(name="arm", observation_parts={"joints": 2, "hand_position": ("x",), "cup_xy": 1, "grip": 1})
    assert named.known_units == named.state_units == ("rad", "rad", "m", "m", "")
    assert get_task("aligning").state_units == ("m",) * 5 + ("", "") + ("m", "m", "", ""), "metres, angles apart"
    assert [thousandths(unit) for unit in ("m", "rad", "")] == [("mm", 1e3), ("mrad", 1e3), ("", 1.0)]


def test_wrong_observations_are_named():
    with pytest.raises(ValueError, match="task 'sorting' has 16 columns, got 4"):
        get_task("sorting").state_of(torch.zeros(2, 4))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_double_yaw_is_continuous_and_unit_length(dtype):
    yaw = torch.linspace(-1.5707, 1.5707, 101, dtype=dtype)[:, None]
    found = double_yaw(yaw.tan())
    assert found.dtype == dtype
    expected = torch.cat([(2 * yaw).cos(), (2 * yaw).sin()], -1)
    assert torch.allclose(found, expected, atol=2e-3 if dtype == torch.float32 else 1e-9)
    # both ends of the range are one and the same direction
    assert torch.allclose(found[0], found[-1], atol=1e-3)


def test_poles_of_the_tangent_are_finite():
    found = double_yaw(torch.tensor([[math.inf], [-math.inf], [1e30]]))
    assert torch.allclose(found, torch.tensor([[-1.0, 0.0]]).expand(3, 2), atol=1e-6)


def test_gradients_of_features_are_finite():
    tangent = torch.tensor([[0.0], [3.0], [1e4]], requires_grad=True)
    double_yaw(tangent).sum().backward()
    assert tangent.grad.isfinite().all()


def test_yaw_of_quaternions_ignores_sign_and_a_small_tilt():
    yaw = torch.linspace(-3.1, 3.1, 25, dtype=torch.float64)
    zero = torch.zeros_like(yaw)
    upright = torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], -1)
    expected = torch.stack([yaw.cos(), yaw.sin()], -1)
    assert torch.allclose(yaw_of(upright), expected) and torch.allclose(yaw_of(-upright), expected)
    tilt = torch.tensor([math.cos(0.02), math.sin(0.02), 0.0, 0.0], dtype=torch.float64)  # 2.3 deg about x, first
    w, _, _, z = upright.unbind(-1)
    tilted = torch.stack([w * tilt[0], w * tilt[1], z * tilt[1], z * tilt[0]], -1)
    assert (yaw_of(tilted) - expected).abs().max() < 2e-3


def test_yaw_is_where_the_first_axis_points_from_above():
    quaternion = torch.nn.functional.normalize(torch.randn(50, 4, dtype=torch.float64), dim=-1)
    axis = Rotation.from_quat(quaternion.roll(-1, -1).numpy()).as_matrix()[:, :2, 0]
    torch.testing.assert_close(yaw_of(quaternion), torch.nn.functional.normalize(torch.from_numpy(axis), dim=-1))
    assert yaw_of(torch.tensor([0.5, -0.5, 0.5, 0.5])).tolist() == [0.0, 0.0]  # it points straight up
