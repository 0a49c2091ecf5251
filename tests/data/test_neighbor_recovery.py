# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows are moved towards their nearest neighbour's present frame, and come back."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import NeighborRecovery
from torchrl_koap.tasks import get_task
from torchrl_koap.training import TrainConfig, resolve
from torchrl_koap.training.planner import augmentation


def moved(windows, share, **options):
    return NeighborRecovery(share, **options)(TensorDict({"state": windows.clone()}, [len(windows)]))["state"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_observed_frames_move_along_the_way_to_the_nearest_other_window_and_the_future_comes_back(dtype):
    torch.manual_seed(0)
    windows = torch.randn(50, 16, 3, dtype=dtype)
    there = moved(windows, 0.6, history=2, decay=0.5)
    assert there.dtype == dtype
    shift = there - windows
    for index, present in enumerate(windows[:, 1]):
        others = [other for other in range(50) if other != index]
        nearest = min(others, key=lambda other: float((windows[other, 1] - present).norm()))
        way = windows[nearest, 1] - present
        share = float(shift[index, 1] @ way / (way @ way))
        assert 0 <= share <= 0.6
        torch.testing.assert_close(shift[index, 1], share * way, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(shift[:, 0], shift[:, 1])  # both observed frames alike: its velocity stays
    for step in range(1, 15):
        torch.testing.assert_close(shift[:, 1 + step], 0.5**step * shift[:, 1], rtol=1e-4, atol=1e-5)


def test_shares_are_spread_over_the_whole_range():
    windows = torch.arange(1000.0).reshape(500, 2).mean(-1)[:, None, None].expand(500, 4, 1)  # neighbours 2 apart
    torch.manual_seed(0)
    sizes = (moved(windows, 1.0) - windows)[:, 0, 0].abs() / 2
    assert sizes.min() < 0.02 and sizes.max() > 0.98 and abs(sizes.mean() - 0.5) < 0.05


def test_nothing_is_moved_without_a_share():
    windows = torch.randn(5, 16, 3)
    assert torch.equal(moved(windows, 0.0), windows)


@pytest.mark.parametrize("shape", [(16, 3), (1, 16, 3), (2, 2, 16, 3)])
def test_windows_without_neighbours_are_refused(shape):
    with pytest.raises(ValueError, match="batch .B, T, d. of two or more"):
        NeighborRecovery(1.0)(TensorDict({"state": torch.zeros(shape)}, shape[:1]))


@pytest.mark.parametrize(("share", "decay"), [(-0.1, 0.7), (float("nan"), 0.7), (1.0, 1.0), (1.0, -0.1)])
def test_numbers_out_of_range_are_refused(share, decay):
    with pytest.raises(ValueError, match="share must be >= 0"):
        NeighborRecovery(share, decay=decay)


@pytest.mark.parametrize(("task", "shares"), [("scooping", [2.0]), ("scooping_moving_bowl", []), ("avoiding", [])])
def test_scooping_has_it_for_its_planner(task, shares):
    def found(**options):
        return [step.share for step in augmentation(get_task(task), **options).module if type(step) is NeighborRecovery]

    assert found() == shares and found(actions=True) == []


def test_a_batch_without_neighbours_is_refused_before_any_work():
    with pytest.raises(ValueError, match="batch_size: the neighbor_recovery of task 'scooping' looks for neighbours"):
        resolve(TrainConfig(out="run", task="scooping", batch_size=1))
    assert resolve(TrainConfig(out="run", task="scooping", method="dp", batch_size=1)).options.batch_size == 1
