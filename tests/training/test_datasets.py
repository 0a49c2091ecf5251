# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests demonstrations of a task, and trajectories held out from the planner."""

import json

import pytest
import torch
from offline_runs import save_arm, train_arm

from torchrl_koap import PlannerConfig, RunConfig
from torchrl_koap.data import LabelBudget, flatten_trajectories, open_dataset, save_ted
from torchrl_koap.data.ted import load_ted
from torchrl_koap.training.datasets import choose_held_out, held_out_by, split_held_out


def flat(count):
    return flatten_trajectories([torch.zeros(5, 2)] * count, [torch.zeros(4, 1)] * count)


def test_trajectories_without_labels_are_taken_first():
    for seed in range(5):
        data, _ = LabelBudget(count=6, seed=seed).apply(flat(10))
        labelled = set(data["episode"][data["has_action"].squeeze(-1)].tolist())
        chosen = choose_held_out(data, 0.4, seed=seed)
        assert len(chosen) == 4 and not labelled & set(chosen)
    assert choose_held_out(data, 0.2, seed=0) != choose_held_out(data, 0.2, seed=1)


def test_where_all_have_labels_some_of_these_are_held_out_and_lose_none():
    data = flat(10)
    chosen = choose_held_out(data, 0.3)
    assert len(chosen) == 3
    planned, unseen, kept = split_held_out(data, chosen)
    assert len(planned["episode"].unique()) == 7 and sorted(unseen["episode"].unique().tolist()) == chosen
    assert len(kept["episode"].unique()) == 10 and kept["has_action"].all()


@pytest.mark.parametrize(
    ("count", "fraction", "number"),
    [(1, 0.1, 0), (2, 0.1, 1), (2, 0.9, 1), (9, 0.1, 1), (10, 0.1, 2), (50, 0.1, 5), (5, 0, 0)],
)
def test_one_is_held_out_at_least_and_one_is_left(count, fraction, number):
    assert len(choose_held_out(flat(count), fraction)) == number


def test_bad_input():
    with pytest.raises(ValueError, match="planner.held_out must be >= 0 and < 1, got 1.5"):
        PlannerConfig(held_out=1.5)
    with pytest.raises(ValueError, match="all 3 trajectories that are used are held out"):
        split_held_out(flat(3), [0, 1, 2])


def test_a_run_lists_them_resumes_and_hands_them_on(tmp_path):
    arm = save_arm(tmp_path / "arm", labelled=8)
    run = train_arm(tmp_path / "run", arm, method="linear")
    config = json.loads((run / "config.json").read_text())
    assert config["planner"]["held_out"] == 0.1 and config["held_out_episodes"] == [8, 9]  # those without a label
    weights = (run / "planner.safetensors").read_bytes()
    for name in ("planner.safetensors", "controller.safetensors", "summary.json"):
        (run / name).unlink()
    train_arm(run, arm, method="linear", run=RunConfig(resume=True))
    assert (run / "planner.safetensors").read_bytes() == weights
    assert json.loads((run / "config.json").read_text())["held_out_episodes"] == [8, 9]
    data, _ = open_dataset(arm)
    assert held_out_by(run, data) == [8, 9]
    data["has_action"] = torch.ones_like(data["has_action"])  # labels that are added change nothing
    assert held_out_by(run, data) == [8, 9]
    more = torch.cat([data[data["episode"] == 3], data])  # a recording that is added comes first
    more["episode"] = torch.cat([torch.zeros(len(more) - len(data), dtype=torch.int64), data["episode"] + 1])
    assert held_out_by(run, more) == [9, 10]
    data["state"] += 1.0  # others have these numbers now
    assert held_out_by(run, data) == []
    again = train_arm(
        tmp_path / "again", arm, method="linear", planner=PlannerConfig(source=run), run=RunConfig(seed=3)
    )
    assert json.loads((again / "config.json").read_text())["held_out_episodes"] == [8, 9]


def test_the_planner_does_not_depend_on_what_is_held_out(tmp_path):
    """Nothing of these trajectories reaches it, not even through its statistics."""
    arm = save_arm(tmp_path / "arm", labelled=8)
    run = train_arm(tmp_path / "run", arm, method="linear")
    data, task = load_ted(arm / "ted")
    for key in ("observation", ("next", "observation")):
        data[key][data["episode"] >= 8] *= 100
    save_ted(data, arm / "ted", task)
    other = train_arm(tmp_path / "other", arm, method="linear")
    for name in ("planner.safetensors", "controller.safetensors"):
        assert (other / name).read_bytes() == (run / name).read_bytes()
