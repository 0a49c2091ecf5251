# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests demonstrations as a TorchRL data set."""

import pytest
from raw_episodes import write_folder
from torchrl.data.datasets import load_dataset

from torchrl_koap.data import D3ILExperienceReplay, LabelBudget, open_dataset, save_ted
from torchrl_koap.tasks import get_task


def test_load_dataset_and_sampling(demonstrations):
    dataset = load_dataset("d3il:avoiding", root=demonstrations, batch_size=6)
    assert isinstance(dataset, D3ILExperienceReplay) and dataset.task is get_task("avoiding")
    assert dataset.sample()["observation"].shape == (6, 4)
    data, _ = open_dataset(demonstrations)
    assert len(dataset) == len(data) and (dataset.data == data).all() and dataset.data_path == demonstrations
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        dataset.extend(dataset.data)


def test_data_sets_of_this_library(demonstrations, tmp_path):
    data, task = open_dataset(demonstrations)
    save_ted(data, tmp_path / "demos" / "ted", task)
    assert (D3ILExperienceReplay("avoiding", tmp_path / "demos").data == data).all()


def test_a_task_that_shares_the_demonstrations_of_another(tmp_path):
    write_folder(tmp_path, "sorting")
    dataset, task = D3ILExperienceReplay("po_sorting", tmp_path), get_task("po_sorting")
    assert dataset.task is task and dataset.data["state"].shape[-1] == task.state_dim < task.observation_dim


def test_label_budget_at_loading(demonstrations):
    dataset = D3ILExperienceReplay("avoiding", demonstrations, label_budget=LabelBudget(count=1, seed=3))
    hidden = ~dataset.data["has_action"].squeeze(-1)
    assert dataset.label_report.trajectories_touched == 1
    assert dataset.data["action"][hidden].isnan().all()
    assert dataset.data["observation"][hidden][:, :2].isnan().all()
    assert dataset.data["observation"][:, 2:].isfinite().all()
    assert D3ILExperienceReplay("avoiding", demonstrations).label_report is None
