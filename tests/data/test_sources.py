# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the loading of demonstration folders: values, task, noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from raw_episodes import write_folder, write_raw_episode
from tiny_runs import write_demonstrations

from torchrl_koap.data import flatten_trajectories, open_dataset, save_demonstrations, save_ted
from torchrl_koap.data.sources import find_task_of
from torchrl_koap.data.ted import load_ted
from torchrl_koap.files import DataError
from torchrl_koap.keys import validate
from torchrl_koap.tasks import TASKS, get_task


def test_values_are_those_of_the_raw_episodes(tmp_path):
    rng, lengths = np.random.default_rng(0), (5, 2, 9)
    robots = [{name: rng.normal(size=(rows, 3)) for name in ("des_c_pos", "c_pos")} for rows in lengths]
    for index, robot in enumerate(robots):
        write_raw_episode(tmp_path / f"env_{index:03d}_00.pkl", robot)
    data, task = open_dataset(tmp_path)
    assert task.name == "avoiding" and validate(data).shape == (13,) and data["has_action"].all()
    begin = 0
    for index, (rows, robot) in enumerate(zip(lengths, robots, strict=True)):
        frames = torch.from_numpy(np.concatenate([robot["des_c_pos"][:, :2], robot["c_pos"][:, :2]], 1))
        part = data[begin : begin + rows - 1]
        assert torch.equal(part["observation"], frames[:-1].float())
        assert torch.equal(part["next", "observation"], frames[1:].float())
        assert torch.equal(part["action"], (frames[1:, :2] - frames[:-1, :2]).float())
        assert torch.equal(part["state"], frames[:-1, 2:].float())
        assert part["episode"].tolist() == [index] * (rows - 1)
        assert part["step_count"].tolist() == list(range(rows - 1))
        assert part["next", "done"].squeeze(-1).tolist() == [False] * (rows - 2) + [True]
        begin += rows - 1


def test_demonstrations_of_another_task_are_used_where_that_is_meant(tmp_path):
    sorting, partial = get_task("sorting"), get_task("po_sorting")
    raw = write_folder(tmp_path / "raw", "sorting")[0].parent
    theirs, _ = open_dataset(raw, task=sorting)
    save_ted(theirs.exclude("state"), tmp_path / "demos" / "ted", sorting)
    save_ted(theirs, tmp_path / "with state", sorting)
    save_ted(theirs, tmp_path / "of its own name", partial)
    wanted = theirs["observation"][:, [2, 3, 4, 5, 7, 8, 10, 11, 13, 14]]  # no yaw
    for folder in (
        raw,
        tmp_path / "demos",
        tmp_path / "demos" / "ted",
        tmp_path / "with state",
        tmp_path / "of its own name",
    ):
        data, task = open_dataset(folder, task=partial)
        assert task is partial and torch.equal(data["action"], theirs["action"])
        torch.testing.assert_close(data["state"], wanted, rtol=0, atol=6 * partial.noise)  # measured with noise
        assert not torch.equal(data["state"], wanted)
    assert open_dataset(tmp_path / "demos")[1] is sorting
    with pytest.raises(DataError, match="holds demonstrations of 'sorting', wanted 'aligning'"):
        open_dataset(tmp_path / "demos", task=get_task("aligning"))


def test_demonstrations_of_po_sorting_are_as_noisy_as_its_rollouts(tmp_path):
    frames = torch.linspace(0.1, 0.5, 200)[:, None].expand(200, 16).contiguous()
    actions = torch.ones(199, 2)
    partial, whole = get_task("po_sorting"), get_task("sorting")
    save_ted(flatten_trajectories([frames] * 3, [actions] * 3), tmp_path / "ted", whole)
    clean, noisy, again = (open_dataset(tmp_path, task=task)[0] for task in (whole, partial, partial))
    assert torch.equal(noisy["observation"], again["observation"]) and torch.equal(noisy["action"], clean["action"])
    change = noisy["observation"] - clean["observation"]
    assert change[:, 2:4].std().item() == pytest.approx(partial.noise, rel=0.1) and partial.noise == 0.002
    others = [column for column in range(16) if column not in (2, 3)]
    assert not change[:, others].any()
    inner = (noisy["step_count"] < 198).squeeze(-1).nonzero().squeeze(-1)
    assert torch.equal(noisy["next", "observation"][inner], noisy["observation"][inner + 1])
    last = torch.tensor([198, 397])  # whose next frame is not the first one of another trajectory
    behind = (noisy["next", "observation"] - clean["next", "observation"])[last, 2:4]
    assert behind.all() and (behind != change[last + 1, 2:4]).all()
    assert noisy["state"].shape[-1] == 10  # no yaw, of planner or controller
    stored, _ = load_ted(tmp_path / "ted")
    assert torch.equal(stored["observation"], clean["observation"])


def test_what_cannot_be_opened(tmp_path):
    with pytest.raises(FileNotFoundError, match="dataset '.*nowhere' is no folder in"):
        open_dataset(tmp_path / "nowhere")
    (tmp_path / "b_raw").mkdir()
    with pytest.raises(FileNotFoundError, match="did you mean '.*/b_raw'. `koap convert DATA --out DIR` makes one"):
        open_dataset(tmp_path / "b_rwa")
    (tmp_path / "b_raw").rmdir()
    with pytest.raises(FileNotFoundError, match="no demonstrations"):
        open_dataset(tmp_path)
    folder = save_demonstrations(tmp_path / "arm", [np.zeros((9, 3))], control_hz=30, action_dim=2)
    assert open_dataset(folder)[1].name == "arm"
    arm = open_dataset(folder)[1]
    write_demonstrations(tmp_path / "raw", episodes=1)
    with pytest.raises(DataError, match="D3IL has no task 'arm': `koap convert` it"):
        open_dataset(tmp_path / "raw", task=arm)
    for name in ("lerobot/meta/info.json", "tables/run.csv", "arm.hdf5"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("{}")
        source = tmp_path / name.partition("/")[0]
        for find in (open_dataset, find_task_of):
            with pytest.raises(DataError, match=f"`koap convert .*{source.name} --out {source.stem}_data`, then"):
                find(str(source))
    save_ted(flatten_trajectories([torch.zeros(5, 3)], [torch.zeros(4, 2)]), tmp_path / "narrow", arm)
    about = (tmp_path / "narrow" / "about.json").read_text().replace('"task": "arm"', '"task": "avoiding"')
    (tmp_path / "narrow" / "about.json").write_text(about)
    with pytest.raises(DataError, match="3 observation and 2 action columns, task 'avoiding' has 4 and 2"):
        open_dataset(tmp_path / "narrow", task=get_task("avoiding"))


def test_a_registered_task_that_the_data_set_overrules_is_said(tmp_path, monkeypatch, recwarn):
    folder = save_demonstrations(tmp_path / "arm", [np.zeros((9, 3))], control_hz=30, action_dim=2)
    own = find_task_of(folder)
    monkeypatch.setitem(TASKS, "arm", own)
    assert find_task_of(folder, "arm") == own and not [item for item in recwarn if "registered" in str(item.message)]
    monkeypatch.setitem(TASKS, "arm", replace(own, env="lab.env:Env"))
    with pytest.warns(UserWarning, match="holds its own task 'arm', which differs from the registered one"):
        assert find_task_of(folder, "arm") == own


def test_an_error_about_missing_data_names_both_commands():
    with pytest.raises(
        ValueError, match="koap demos --task sorting --out DEMOS.*koap train --task sorting --dataset DEMOS"
    ):
        find_task_of(None, "sorting")
