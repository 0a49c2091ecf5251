# This source code is licensed under the MIT license found in the LICENSE file.
"""Recovery and extrapolation in closed form; windows cut at once equal those of a buffer."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import (
    ObjectPermutation,
    RandomPlanarTransform,
    RecoveryAugmentation,
    cut_windows,
    extrapolate_ends,
    make_window_buffer,
)
from torchrl_koap.tasks.panda_kinematics import tool_position


def flat(lengths, *, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    episode = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    state = torch.randn(len(episode), 2, generator=generator, dtype=dtype)
    return TensorDict(
        {"state": state, "episode": episode, "has_action": torch.ones(len(episode), 1).bool()}, [len(episode)]
    )


@pytest.mark.parametrize(("history", "decay"), [(2, 0.7), (1, 0.5), (4, 0.0)])
def test_shift_is_constant_in_the_history_and_decays_geometrically(history, decay):
    torch.manual_seed(0)
    state = torch.randn(5, 3, 10, 2, dtype=torch.float64)
    augment = RecoveryAugmentation(0.01, history=history, decay=decay)
    shift = augment(TensorDict({"state": state.clone()}, [5, 3]))["state"] - state
    delta = shift[..., 0, :]
    assert (delta.abs() > 0).all() and delta.flatten(0, 1).unique(dim=0).shape[0] == 15  # one draw per window
    for frame in range(10):
        remaining = decay ** max(0, frame - history + 1)
        torch.testing.assert_close(shift[..., frame, :], delta * remaining, atol=1e-14, rtol=0)


def test_size_of_the_shift():
    """delta = 2 sigma r n has variance 4 sigma^2 E[r^2] = 4/3 sigma^2 per axis."""
    torch.manual_seed(0)
    td = RecoveryAugmentation(0.004)(TensorDict({"state": torch.zeros(40_000, 3, 2, dtype=torch.float64)}, [40_000]))
    assert td["state"][:, 0].mean().abs() < 1e-4
    assert td["state"][:, 0].square().mean().sqrt().item() == pytest.approx(0.004 * math.sqrt(4 / 3), rel=0.02)


def test_no_sigma_changes_nothing_and_options_are_checked():
    state = torch.randn(4, 16, 2)
    assert torch.equal(RecoveryAugmentation(0.0)(TensorDict({"state": state.clone()}, [4]))["state"], state)
    renamed = RecoveryAugmentation(0.1, key=("a", "b"))(TensorDict({"a": {"b": state.clone()}}, [4]))
    assert not torch.equal(renamed["a", "b"], state)
    for options in ({"sigma": -1.0}, {"sigma": 1.0, "decay": 1.0}):
        with pytest.raises(ValueError, match="sigma must be >= 0 and decay"):
            RecoveryAugmentation(**options)


@pytest.mark.parametrize("over", [1, 3])
def test_trajectories_go_on_at_their_last_mean_velocity(over):
    data = flat([6, 4, 9], dtype=torch.float64)
    extended = extrapolate_ends(data, 5, over=over)
    assert torch.unique_consecutive(extended["episode"], return_counts=True)[1].tolist() == [11, 9, 14]
    for episode, length in enumerate([6, 4, 9]):
        before = data["state"][data["episode"] == episode]
        after = extended["state"][extended["episode"] == episode]
        assert torch.equal(after[:length], before)
        velocity = (before[-1] - before[-1 - over]) / over
        for ahead in range(1, 6):
            torch.testing.assert_close(after[length - 1 + ahead], before[-1] + ahead * velocity)


def test_a_trajectory_of_one_step_stands_still_and_short_ones_use_what_there_is():
    data = flat([1, 2])
    extended = extrapolate_ends(data, 2)["state"]
    assert torch.equal(extended[1], data["state"][0]) and torch.equal(extended[2], data["state"][0])
    torch.testing.assert_close(extended[-1], 3 * data["state"][2] - 2 * data["state"][1])


@pytest.mark.parametrize("pad_before", [0, 1, 4])
def test_windows_cut_at_once_are_those_of_the_buffer(pad_before):
    data = flat([9, 5, 12])
    cut = cut_windows(data, 5, select=["state", "episode"], pad_before=pad_before)
    buffer = make_window_buffer(
        data, 5, len(cut), select=["state", "episode"], pad_before=pad_before, replacement=False, drop_last=False
    )
    epoch = buffer.sample()
    assert cut.shape == epoch.shape == (sum(n + pad_before - 4 for n in (9, 5, 12)), 5)

    def rows(windows):
        return sorted(map(tuple, windows["state"].flatten(1).tolist()))

    assert rows(cut) == rows(epoch)
    assert (cut["episode"] == cut["episode"][:, :1]).all()
    first = cut["padded"].squeeze(-1)
    assert first.sum() == 3 * sum(range(pad_before + 1))
    for window, padded in zip(cut["state"], first, strict=True):
        assert (window[: padded.sum() + 1] == window[0]).all()  # the first frame is repeated
    assert set(cut.keys()) == {"state", "episode", "padded"}


def test_windows_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"1 of 3 trajectories are shorter than a window \(6 steps\): 1 \(5 steps\)"):
        cut_windows(flat([9, 5, 12]), 6)


def windows(count=64, width=8):
    return torch.randn(count, 16, width, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_a_moved_scene_keeps_every_distance_and_angle():
    state = windows()
    state[..., 4:6] /= state[..., 4:6].norm(dim=-1, keepdim=True)
    augment = RandomPlanarTransform([(0, 1), (2, 3)], [(4, 5)], shift=0.3, turn=0.8)
    moved = augment(TensorDict({"state": state}, [64]))["state"]

    def seen_from_tool(values):
        gap = values[..., 2:4] - values[..., 0:2]
        cosine, sine = values[..., 4:6].unbind(-1)
        return torch.stack([cosine * gap[..., 0] + sine * gap[..., 1], cosine * gap[..., 1] - sine * gap[..., 0]], -1)

    torch.testing.assert_close(seen_from_tool(moved), seen_from_tool(state))
    torch.testing.assert_close(moved[..., 4:6].norm(dim=-1), torch.ones(64, 16, dtype=torch.float64))
    assert torch.equal(moved[..., 6:], state[..., 6:])
    # one motion per window: steps keep their length, windows move differently
    torch.testing.assert_close(moved[..., :2].diff(dim=-2).norm(dim=-1), state[..., :2].diff(dim=-2).norm(dim=-1))
    shift = moved[:, 1, :2] - state[:, 1, :2]  # the turn is about the tool in the last observed frame
    assert 0.2 < shift.std() < 0.4


def test_a_scene_may_stay_where_it_is():
    state = windows()
    same = RandomPlanarTransform([(0, 1)], [(4, 5)], shift=0.0, turn=0.0)(TensorDict({"state": state}, [64]))["state"]
    torch.testing.assert_close(same, state)
    with pytest.raises(ValueError, match="shift and turn must be >= 0, got -1"):
        RandomPlanarTransform([(0, 1)], [], shift=-1, turn=0)


def test_alike_objects_are_exchanged_whole_and_all_the_time_of_a_window():
    state = windows(count=400)
    augment = ObjectPermutation([[(1, 2), (3, 4)], [(5,), (6,), (7,)]])
    found = augment(TensorDict({"state": state}, [400]))["state"]
    assert torch.equal(found[..., 0], state[..., 0])
    kept = (found[..., 1:5] == state[..., 1:5]).all(-1).all(-1)
    swapped = (found[..., 1:5] == state[..., [3, 4, 1, 2]]).all(-1).all(-1)
    assert (kept ^ swapped).all() and 140 < swapped.sum() < 260
    torch.testing.assert_close(found[..., 5:].sort(-1).values, state[..., 5:].sort(-1).values)
    orders = {tuple(row.tolist()) for row in (found[:, 0, 5:, None] == state[:, 0, None, 5:]).int().argmax(-1)}
    assert len(orders) == 6


def test_shifted_columns_may_be_chosen():
    state = torch.zeros(50, 16, 4)
    found = RecoveryAugmentation(0.01, columns=(0, 2))(TensorDict({"state": state}, [50]))["state"]
    assert found[..., [0, 2]].any() and not found[..., [1, 3]].any()


def test_joints_follow_the_tool_aside_and_come_back_with_it():
    bent = torch.tensor([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.8], dtype=torch.float64)  # rad, over a table
    joints = bent + 0.1 * torch.rand(30, 16, 7, dtype=torch.float64)
    state = torch.cat([joints, torch.rand(30, 16, 1).double(), tool_position(joints)], -1)
    augment = RecoveryAugmentation(0.02, columns=range(7), tool=(8, 9, 10), kinematics=tool_position)
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
    with pytest.raises(ValueError, match="wanted columns and kinematics"):
        RecoveryAugmentation(0.02, columns=(0, 1), tool=(2, 3, 4))


def test_actions_follow_the_way_back_and_the_turned_scene():
    """Actions that move the state stay its differences; labels that are hidden stay hidden."""
    torch.manual_seed(0)
    state = torch.randn(6, 16, 4).cumsum(1)
    action = torch.cat([state[..., :2].diff(dim=1), torch.full((6, 1, 2), torch.nan)], 1)
    windows = TensorDict({"state": state, "action": action}, [6])
    recover = RecoveryAugmentation(0.1, columns=[0, 1], moved_by=[0, 1])
    turn = RandomPlanarTransform([(0, 1), (2, 3)], [], shift=0.1, turn=0.5, turned_actions=[0, 1])
    for augment in (recover, turn):
        moved = augment(windows.clone())
        torch.testing.assert_close(moved["action"][:, :-1], moved["state"][..., :2].diff(dim=1))
        assert moved["action"][:, -1].isnan().all() and not torch.equal(moved["action"][:, :-1], action[:, :-1])
    assert torch.equal(turn(windows.clone())["state"].isnan(), state.isnan())


def test_states_are_moved_alike_with_actions_and_without():
    windows = TensorDict({"state": torch.randn(6, 16, 4), "action": torch.zeros(6, 16, 2)}, [6])
    for make, extra in (
        (lambda **more: RecoveryAugmentation(0.1, columns=[0, 1], **more), {"moved_by": [0, 1]}),
        (lambda **more: RandomPlanarTransform([(0, 1)], [], shift=0.1, turn=0.5, **more), {"turned_actions": [0, 1]}),
    ):
        states = []
        for options in ({}, extra):
            torch.manual_seed(3)
            states.append(make(**options)(windows.clone())["state"])
        assert torch.equal(*states)
