# This source code is licensed under the MIT license found in the LICENSE file.
"""Using part of the trajectories: labelled ones stay, shares nest, and a share that cannot be kept is named."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.data import LabelBudget, flatten_trajectories, subsample_trajectories

LENGTHS = [20 + 3 * index for index in range(10)]


def make_data(labelled=2, seed=0):
    states = [torch.full((length + 1, 2), float(index)) for index, length in enumerate(LENGTHS)]
    actions = [torch.full((length, 1), float(index)) for index, length in enumerate(LENGTHS)]
    data = flatten_trajectories(states, actions)
    return data if labelled is None else LabelBudget(count=labelled, seed=seed).apply(data)[0]


def kept_of(data):
    return set(data["episode"].unique().tolist())


def labelled_of(data):
    return set(data["episode"][data["has_action"].squeeze(-1)].unique().tolist())


@pytest.mark.parametrize("seed", range(4))
def test_whole_trajectories_are_kept_in_their_order_with_all_labels(seed):
    data = make_data(3, seed)
    before = data.clone()
    kept = subsample_trajectories(data, 0.5, seed=seed)
    episodes = kept["episode"].unique_consecutive()
    assert len(episodes) == 5 and (episodes.diff() > 0).all()
    assert [int((kept["episode"] == episode).sum()) for episode in episodes] == [LENGTHS[e] for e in episodes]
    assert labelled_of(kept) == labelled_of(data) <= kept_of(kept)
    assert int(kept["has_action"].sum()) == int(data["has_action"].sum())
    assert (kept["observation"][:, 0] == kept["episode"]).all()
    for key in before.keys(True, True):
        torch.testing.assert_close(data[key], before[key], equal_nan=True)


@pytest.mark.parametrize("seed", range(4))
def test_a_smaller_share_is_part_of_every_larger_one(seed):
    data = make_data(1, seed)
    shares = [kept_of(subsample_trajectories(data, share / 10, seed=seed)) for share in range(1, 11)]
    assert [len(share) for share in shares] == list(range(1, 11))
    assert all(small < large for small, large in zip(shares, shares[1:], strict=False))


def test_the_seed_chooses_and_everything_is_everything():
    data = make_data(1)
    assert len({frozenset(kept_of(subsample_trajectories(data, 0.5, seed=seed))) for seed in range(8)}) > 1
    assert subsample_trajectories(data, 1.0) is data
    assert subsample_trajectories(data, 0.97) is data  # 9.7 of 10


def test_without_labels_any_share_may_be_kept():
    data = make_data(None)
    data["has_action"] = torch.zeros_like(data["has_action"])
    assert len(kept_of(subsample_trajectories(data, 0.1))) == 1


@pytest.mark.parametrize(
    ("labelled", "fraction", "message"),
    [
        (1, 0.0, r"must be in \(0, 1\], got 0"),
        (1, 1.5, r"must be in \(0, 1\], got 1.5"),
        (1, -0.1, r"must be in \(0, 1\]"),
        (1, math.nan, r"must be in \(0, 1\], got nan"),
        (3, 0.2, "0.2 keeps 2 of 10 trajectories, but 3 have labels"),
        (None, 0.04, "0.04 keeps 0 of 10 trajectories"),
    ],
)
def test_a_share_that_cannot_be_kept_is_named(labelled, fraction, message):
    with pytest.raises(ValueError, match=message):
        subsample_trajectories(make_data(labelled), fraction)
