# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the conversion of trajectories with and without actions to a flat tensordict with label marks."""

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import extrapolate_ends, flatten_trajectories, select_state
from torchrl_koap.data.trajectories import begins, mark_labels
from torchrl_koap.keys import validate


def test_none_and_nan_rows_mean_no_label():
    frames = [torch.rand(4, 2), torch.rand(3, 2), torch.rand(5, 2)]
    actions = torch.rand(4, 3)
    actions[1] = math.nan
    data = flatten_trajectories(frames, [None, torch.ones(2, 3), actions])
    validate(data)
    assert data["has_action"].flatten().tolist() == [False] * 3 + [True] * 2 + [True, False, True, True]
    assert data["action"].shape == (9, 3) and torch.equal(data["action"][5], actions[0])
    assert data["action"][[0, 1, 2, 6]].isnan().all() and data["action"].dtype == torch.float32
    double = flatten_trajectories(frames, [None, torch.ones(2, 3), actions], dtype=torch.float64)
    assert double["action"].dtype == torch.float64


def test_no_actions_at_all_need_their_size():
    frames = [torch.rand(4, 2)] * 2
    for actions in (None, [None, None]):
        data = flatten_trajectories(frames, actions, action_dim=7)
        validate(data)
        assert data["action"].shape == (6, 7) and not data["has_action"].any()
        with pytest.raises(ValueError, match="no trajectory has actions: action_dim is needed"):
            flatten_trajectories(frames, actions)


def test_wrong_shapes_and_numbers_are_named():
    frames = [torch.rand(4, 2)] * 2
    with pytest.raises(ValueError, match=r"trajectory 0: wanted .* actions \[T - 1, act\] .* got \[4, 2\] and \[3\]"):
        flatten_trajectories(frames, [torch.rand(3)] * 2)
    with pytest.raises(ValueError, match="2 trajectories of observations, 1 of actions"):
        flatten_trajectories(frames, [None])
    with pytest.raises(ValueError, match=r"trajectory 1: wanted .* got \[4, 2\] and \[4, 3\]"):
        flatten_trajectories(frames, [None, torch.ones(4, 3)])
    with pytest.raises(ValueError, match=r"trajectory 1: wanted .* with T >= 2, got \[1, 2\] and \[0, 3\]"):
        flatten_trajectories([frames[0], torch.rand(1, 2)], [torch.ones(3, 3), None])
    with pytest.raises(ValueError, match="trajectory 1 has 2 observation and 4 action columns, wanted 2 and 3"):
        flatten_trajectories(frames, [torch.ones(3, 3), torch.ones(3, 4)])
    for value in (math.nan, math.inf):
        steps = torch.ones(3, 3)
        steps[2, 1] = value
        with pytest.raises(ValueError, match="trajectory 1: 1 actions are infinite or NaN in some .*, first at step 2"):
            flatten_trajectories(frames, [None, steps])


def test_columns_of_the_state_are_chosen_by_number():
    data = flatten_trajectories([torch.rand(4, 4)], None, action_dim=1)
    assert (
        torch.equal(select_state(data, (3, 2))["state"], data["observation"][:, [3, 2]]) and "state" not in data.keys()
    )
    for wrong in ((), (4,), (-1,)):
        with pytest.raises(ValueError, match=r"0\.\.3"):
            select_state(data, wrong)


def test_labels_are_marked_where_actions_are():
    data = flatten_trajectories([torch.rand(4, 2)], [torch.rand(3, 2)])
    data["action"][1] = math.nan
    assert mark_labels(data.exclude("has_action"))["has_action"].flatten().tolist() == [True, False, True]
    bare = mark_labels(data.exclude("has_action", "action"), action_dim=2)
    validate(bare)
    assert not bare["has_action"].any()


def test_trajectories_begin_where_their_number_changes():
    episode = torch.tensor([5, 5, 3, 9, 9])
    assert begins(TensorDict({"episode": episode}, [5])).tolist() == [True, False, True, True, False]


def flat(lengths, *, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    episode = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    state = torch.randn(len(episode), 2, generator=generator, dtype=dtype)
    return TensorDict(
        {"state": state, "episode": episode, "has_action": torch.ones(len(episode), 1).bool()}, [len(episode)]
    )


def test_trajectories_go_on_at_their_last_mean_velocity():
    data = flat([6, 4, 9], dtype=torch.float64).to("cpu")
    data["episode"] = data["episode"] + 5
    extended = extrapolate_ends(data, 5)
    assert extended.device == data.device  # or samples of it hold indices of another one, which no CUDA graph takes
    assert extended["episode"].tolist() == [5] * 11 + [6] * 9 + [7] * 14
    for episode, length in enumerate([6, 4, 9], 5):
        before = data["state"][data["episode"] == episode]
        after = extended["state"][extended["episode"] == episode]
        assert torch.equal(after[:length], before)
        velocity = (before[-1] - before[-4]) / 3
        for ahead in range(1, 6):
            torch.testing.assert_close(after[length - 1 + ahead], before[-1] + ahead * velocity)


def test_a_trajectory_of_one_step_stands_still_and_short_ones_use_what_there_is():
    data = flat([1, 2])
    extended = extrapolate_ends(data, 2)["state"]
    assert torch.equal(extended[1], data["state"][0]) and torch.equal(extended[2], data["state"][0])
    torch.testing.assert_close(extended[-1], 3 * data["state"][2] - 2 * data["state"][1])
