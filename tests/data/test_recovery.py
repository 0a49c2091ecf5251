# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests recovery augmentation in closed form: of the robot, of grippers, and along differences of windows."""

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import RecoveryAugmentation
from torchrl_koap.data.recovery import GripperRecovery, NeighborRecovery
from torchrl_koap.tasks.action_rules import PLANNED_OPEN_ABOVE, gripper_command
from torchrl_koap.tasks.panda_kinematics import tool_position

OPEN, HELD = 0.08, 0.0617


@pytest.mark.parametrize(
    ("history", "decay", "under_way"), [(2, 0.7, False), (1, 0.5, True), (4, 0, False), (3, 0.6, 1)]
)
def test_shift_decays_geometrically_after_the_history_or_from_its_start(history, decay, under_way):
    torch.manual_seed(0)
    state = torch.randn(5, 3, 10, 2, dtype=torch.float64)
    augment = RecoveryAugmentation(0.01, history=history, decay=decay, under_way=bool(under_way))
    shift = augment(TensorDict({"state": state.clone()}, [5, 3]))["state"] - state
    delta = shift[..., history - 1, :]
    assert (delta.abs() > 0).all() and delta.flatten(0, 1).unique(dim=0).shape[0] == 15  # one draw per window
    for frame in range(10):
        remaining = decay ** (frame - history + 1 if under_way else max(0, frame - history + 1))
        torch.testing.assert_close(shift[..., frame, :], delta * remaining, atol=1e-14, rtol=0)


def test_size_of_the_shift():
    """delta = 2 sigma r n has variance 4 sigma^2 E[r^2] = 4/3 sigma^2 per axis."""
    torch.manual_seed(0)
    td = RecoveryAugmentation(0.004)(TensorDict({"state": torch.zeros(40_000, 3, 2, dtype=torch.float64)}, [40_000]))
    assert td["state"][:, 0].mean().abs() < 1e-4
    assert td["state"][:, 0].square().mean().sqrt().item() == pytest.approx(0.004 * math.sqrt(4 / 3), rel=0.02)


def test_every_column_may_have_its_own_shift():
    torch.manual_seed(0)
    state = torch.zeros(40_000, 3, 3, dtype=torch.float64)
    found = RecoveryAugmentation(torch.tensor([5.0, 0.01, 0.0]))(TensorDict({"state": state}, [40_000]))["state"][:, 0]
    wanted = math.sqrt(4 / 3) * torch.tensor([5.0, 0.01, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found.square().mean(0).sqrt(), wanted, rtol=0.02, atol=0)
    with pytest.raises(ValueError, match="sigma must be >= 0"):
        RecoveryAugmentation(torch.tensor([1.0, -1.0]))


def test_shifted_columns_may_be_chosen():
    state = torch.zeros(50, 16, 4)
    found = RecoveryAugmentation(0.01, columns=(0, 2))(TensorDict({"state": state}, [50]))["state"]
    assert found[..., [0, 2]].any() and not found[..., [1, 3]].any()


def test_joints_follow_the_shifted_tool_and_return_with_it():
    bent = torch.tensor([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.8], dtype=torch.float64)  # rad, over a table
    joints = bent + 0.1 * torch.rand(30, 16, 7, dtype=torch.float64)
    state = torch.cat([joints, torch.rand(30, 16, 1).double(), tool_position(joints)], -1)
    sizes = torch.tensor([0.0] * 8 + [0.02] * 3)
    augment = RecoveryAugmentation(sizes, columns=range(7), tool=(8, 9, 10), kinematics=tool_position)
    found = augment(TensorDict({"state": state.clone()}, [30]))["state"]
    torch.testing.assert_close(found[..., 8:], tool_position(found[..., :7]))
    assert torch.equal(found[..., 7], state[..., 7])
    away = (found - state)[..., 8:].norm(dim=-1)
    assert 0.02 < away[:, 1].mean() < 0.05 and away[:, 15].mean() < 0.02 * away[:, 1].mean()
    # the least motion: no part of it turns the elbow about and leaves the tool where it is
    jacobian = torch.func.vmap(torch.func.jacfwd(tool_position))(state[:, 1, :7])
    moved = (found - state)[:, 1, :7]
    idle = moved - (torch.linalg.pinv(jacobian) @ jacobian @ moved[..., None])[..., 0]
    assert idle.norm(dim=-1).max() < 1e-4 * moved.norm(dim=-1).mean()


def test_a_shift_of_the_joints_turns_the_tool_and_moves_it_only_as_drawn():
    torch.manual_seed(0)
    joints = torch.tensor([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.8]).double().expand(400, 16, 7)
    state = torch.cat([joints, tool_position(joints)], -1)
    augment = RecoveryAugmentation(
        torch.tensor([0.1] * 7 + [0.004] * 3), columns=range(7), tool=(7, 8, 9), kinematics=tool_position
    )
    found = augment(TensorDict({"state": state.clone()}, [400]))["state"]
    torch.testing.assert_close(found[..., 7:], tool_position(found[..., :7]))
    away = (found - state)[:, 1].square().mean(0).sqrt()
    assert (away[7:] < 0.008).all()  # m; the joints alone would move it by centimetres
    assert 0.1 < away[6] < 0.13  # rad; the last joint turns the tool where it is


def changed(widths, share=1.0, **options):
    window = torch.stack([torch.arange(16.0), torch.tensor(widths)], -1)
    return GripperRecovery(1, share=share, **options)(TensorDict({"state": window.clone()}, []))["state"]


def test_open_fingers_are_seen_closed_and_open_again():
    torch.manual_seed(0)
    widths = changed([OPEN] * 16)[:, 1]
    assert widths[0] == widths[1] < 0.05  # both observed frames
    assert (widths[1:].diff() > 0).all() and widths[6] > 0.075 and widths[-1] <= OPEN
    numbers = gripper_command(widths, open_above=PLANNED_OPEN_ABOVE)
    assert (numbers[1:] >= OPEN).all()  # the number that opens, from the present step on


@pytest.mark.parametrize(
    "widths",
    [
        [HELD] * 16,
        [OPEN] * 4 + [HELD] * 12,  # closes before the fingers could be open
        [HELD] * 2 + [OPEN] * 14,  # lets go of something
        [0.0, 0.03] + [OPEN] * 14,  # opens by itself, at the start of an episode
    ],
)
def test_fingers_that_hold_or_move_are_not_shifted(widths):
    torch.testing.assert_close(changed(widths)[:, 1], torch.tensor(widths))


def test_a_grasp_later_in_the_window_is_still_done():
    widths = changed([OPEN] * 10 + [HELD] * 6)[:, 1]
    assert widths[0] < 0.05 and widths[8] > 0.077
    torch.testing.assert_close(widths[10:], torch.full([6], HELD))


def test_no_other_column_is_touched_and_the_share_is_kept():
    torch.manual_seed(0)
    windows = torch.full([4000, 2, 16, 3], OPEN)
    state = GripperRecovery(2, share=0.1)(TensorDict({"state": windows.clone()}, [4000, 2]))["state"]
    assert (state[..., :2] == OPEN).all()
    done = (state[..., 0, 2] < 0.05).float().mean()
    assert 0.09 < done < 0.11
    begin = state[..., 0, 2][state[..., 0, 2] < 0.05]
    assert begin.min() < 0.002 and begin.max() > 0.048


def moved(windows, share, **options):
    return NeighborRecovery(share, **options)(TensorDict({"state": windows.clone()}, [len(windows)]))["state"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_observed_frames_move_along_the_way_to_the_nearest_other_window_and_the_future_comes_back(dtype):
    torch.manual_seed(0)
    windows = torch.randn(50, 16, 3, dtype=dtype)
    there = moved(windows, 0.6, history=2)
    assert there.dtype == dtype
    shift = there - windows
    for index, present in enumerate(windows[:, 1]):
        others = [other for other in range(50) if other != index]
        nearest = min(others, key=lambda other: float((windows[other, 1] - present).norm()))
        way = windows[nearest, 1] - present
        share = float(shift[index, 1] @ way / (way @ way))
        assert 0 < share <= 0.6
        torch.testing.assert_close(shift[index, 1], share * way, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(shift[:, 0], shift[:, 1])  # both observed frames alike: its velocity stays
    for step in range(1, 15):
        torch.testing.assert_close(shift[:, 1 + step], 0.85**step * shift[:, 1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shape", [(16, 3), (1, 16, 3), (2, 2, 16, 3)])
def test_windows_without_neighbours_are_refused(shape):
    with pytest.raises(ValueError, match="batch of states .B, T, d. with B >= 2"):
        NeighborRecovery(1.0)(TensorDict({"state": torch.zeros(shape)}, shape[:1]))


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (RecoveryAugmentation, {"sigma": -1.0}, "sigma must be >= 0 and decay"),
        (RecoveryAugmentation, {"sigma": 1.0, "decay": 1.0}, "sigma must be >= 0 and decay"),
        (RecoveryAugmentation, {"sigma": 1.0, "decay": 0.0, "under_way": True}, "sigma must be >= 0 and decay"),
        (RecoveryAugmentation, {"sigma": 1.0, "columns": (0,), "tool": (2, 3, 4)}, "wanted columns and kinematics"),
        *((NeighborRecovery, {"share": share}, "share must be >= 0") for share in (-0.1, math.nan)),
    ],
)
def test_options_out_of_range_are_refused(kind, options, message):
    with pytest.raises(ValueError, match=message):
        kind(**options)
