# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests augmentation that moves and turns whole scenes and exchanges equal objects."""

import functools

import pytest
import torch
from counted_windows import moving_windows
from tensordict import TensorDict

from torchrl_koap.data import ObjectPermutation, RandomPlanarTransform, RecoveryAugmentation


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


def test_a_scene_may_stay_unchanged():
    state = windows()
    same = RandomPlanarTransform([(0, 1)], [(4, 5)], shift=0.0, turn=0.0)(TensorDict({"state": state}, [64]))["state"]
    torch.testing.assert_close(same, state)
    with pytest.raises(ValueError, match="shift and turn must be >= 0, got -1"):
        RandomPlanarTransform([(0, 1)], [], shift=-1, turn=0)


def test_equal_objects_are_exchanged_completely_for_a_whole_window():
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


PLANAR = functools.partial(RandomPlanarTransform, [(0, 1)], [], shift=0.1, turn=0.5)
RECOVERY = functools.partial(RecoveryAugmentation, 0.1, columns=[0, 1])


@pytest.mark.parametrize(
    ("augment", "option"),
    [
        (PLANAR, "turned_actions"),
        (RECOVERY, "moved_by"),
        (functools.partial(RECOVERY, under_way=True, history=3), "moved_by"),
    ],
    ids=["turned", "recovery", "recovery under way"],
)
def test_actions_that_move_the_state_stay_its_differences(augment, option):
    """Labels that are hidden stay hidden, and states are drawn as without actions."""
    windows = moving_windows()
    moved = augment(**{option: [0, 1]})(windows.clone())
    torch.testing.assert_close(moved["action"][:, :-1], moved["state"][..., :2].diff(dim=1))
    assert moved["action"][:, -1].isnan().all() and not torch.equal(moved["action"][:, :-1], windows["action"][:, :-1])
    moving_windows()  # draws again from the same seed
    assert torch.equal(moved["state"], augment()(windows.clone())["state"])


@pytest.mark.parametrize(
    "augment",
    [
        functools.partial(PLANAR, turned_actions=[0, 1]),
        functools.partial(RECOVERY, moved_by=[0, 1]),
        functools.partial(ObjectPermutation, [[(0, 1), (2, 3)]]),
    ],
    ids=["planar", "recovery", "objects"],
)
def test_keys_may_have_other_names(augment):
    windows = moving_windows()
    names = {"state_key": ("seen", "x")} | ({"action_key": "command"} if len(augment().in_keys) > 1 else {})
    torch.manual_seed(1)
    wanted = augment()(windows.clone())
    torch.manual_seed(1)
    renamed = augment(**names)(
        TensorDict({"seen": {"x": windows["state"]}, "command": windows["action"]}, [len(windows)])
    )
    assert torch.equal(renamed["seen", "x"], wanted["state"]) and set(renamed.keys()) == {"seen", "command"}
    assert not torch.equal(wanted["state"], windows["state"])
    torch.testing.assert_close(renamed["command"], wanted["action"], equal_nan=True)
