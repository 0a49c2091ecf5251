# This source code is licensed under the MIT license found in the LICENSE file.
"""Trajectories that become flat steps on disk, a part of them in memory at a time."""

from __future__ import annotations

import errno
import os
import weakref

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data import flatten_trajectories, load_ted, save_ted, select_state
from torchrl_koap.data import steps_on_disk as module
from torchrl_koap.data.steps_on_disk import flatten_on_disk, join_on_disk


def trajectories(number: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    generator = torch.Generator().manual_seed(number)
    return [
        (torch.rand(4 + index % 5, 3, generator=generator), torch.rand(3 + index % 5, 2, generator=generator))
        for index in range(number)
    ]


@pytest.mark.parametrize("part", [1, 7, 20, 10_000])
def test_parts_do_not_show(tmp_path, part):
    data = trajectories(23)
    wanted = select_state(flatten_trajectories(*zip(*data, strict=True)), (0, 2))
    found = flatten_on_disk(iter(data), tmp_path, finish=lambda steps: select_state(steps, (0, 2)), part=part)
    assert found.is_memmap() and set(found.keys(True, True)) == set(wanted.keys(True, True))
    assert (found == wanted).all()
    assert all(found[key].dtype == wanted[key].dtype for key in wanted.keys(True, True))


def test_only_a_part_of_the_trajectories_is_held(tmp_path):
    held: list[weakref.ref] = []
    most = 0

    def come():
        nonlocal most
        for index in range(100):
            frames = torch.full((6, 2), float(index))
            held.append(weakref.ref(frames))
            most = max(most, sum(reference() is not None for reference in held))
            yield frames, torch.zeros(5, 1)
            del frames

    assert len(flatten_on_disk(come(), tmp_path, part=60)) == 500
    assert most <= 21  # two parts of ten: one that is written, one that is read


def test_a_trajectory_that_does_not_fit_is_named_by_its_own_number(tmp_path):
    data = [*trajectories(11), (torch.zeros(4, 3), torch.zeros(4, 2))]
    with pytest.raises(ValueError, match="trajectory 11"):
        flatten_on_disk(data, tmp_path, part=8)
    with pytest.raises(ValueError, match="no trajectories"):
        flatten_on_disk([], tmp_path)


def test_parts_of_another_length_than_said(tmp_path):
    part = TensorDict({"action": torch.zeros(3, 1)}, [3])
    with pytest.raises(ValueError, match="more than 5"):
        join_on_disk([part, part], 5, tmp_path / "a")
    with pytest.raises(ValueError, match="have 6 steps, wanted 7"):
        join_on_disk([part, part], 7, tmp_path / "b")


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system cannot reserve place on a disk")
def test_a_full_disk_is_an_error_with_a_name_and_no_signal(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*action\.memmap'"):
        save_ted(flatten_trajectories(*zip(*trajectories(3), strict=True)), tmp_path / "ted")
    assert not (tmp_path / "ted").exists() and not list(tmp_path.iterdir())


def test_statistics_of_data_in_parts(tmp_path, monkeypatch):
    from torchrl_koap.data import ted

    data = flatten_trajectories(*zip(*trajectories(9), strict=True))
    data["action"][3:6] = torch.nan
    data["has_action"][3:6] = False
    monkeypatch.setattr(ted, "PART", 4)
    found = ted.read_about(save_ted(data, tmp_path / "ted"))["statistics"]["action"]
    labelled = data["action"][data["has_action"].squeeze(-1)].double()
    assert found["mean"] == pytest.approx(labelled.mean(0).tolist(), abs=1e-12)
    assert found["std"] == pytest.approx(labelled.std(0, correction=0).tolist(), abs=1e-12)
    assert found["min"] == labelled.amin(0).tolist() and found["max"] == labelled.amax(0).tolist()
    assert (load_ted(tmp_path / "ted")["observation"] == data["observation"]).all()
    assert module.PART >= 4096
