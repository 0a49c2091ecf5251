# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw folders become the right numbers; caches heal; faults of many files come together."""

from __future__ import annotations

import concurrent.futures
import errno
import os
import pickle
import shutil

import numpy as np
import pytest
import torch
from shared_data import HUMAN
from tensordict import TensorDict
from torchrl.data.datasets import load_dataset

from torchrl_koap.data import (
    D3ILExperienceReplay,
    DamagedDataError,
    LabelBudget,
    RawEpisode,
    RawFolderError,
    flatten_trajectories,
    load_ted,
    read_about,
    save_ted,
    write_raw_episode,
)
from torchrl_koap.data.d3il import replay as d3il_module
from torchrl_koap.keys import LayoutError, validate

LENGTHS = (5, 2, 9)


def write_demo(path, rows, seed=0, objects=()):
    rng = np.random.default_rng(seed)
    robot = {"des_c_pos": rng.normal(size=(rows, 3)), "c_pos": rng.normal(size=(rows, 3))}
    poses = {name: {"pos": np.zeros((rows, 3)), "quat": np.zeros((rows, 4))} for name in objects}
    write_raw_episode(path, RawEpisode(robot=robot, objects=poses))
    return robot


@pytest.fixture
def folder(tmp_path):
    for index, rows in enumerate(LENGTHS):
        write_demo(tmp_path / "raw" / f"env_{index:03d}_00.pkl", rows, seed=index)
    return tmp_path / "raw"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("KOAP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_are_those_of_the_raw_episodes(folder, dtype):
    data = validate(D3ILExperienceReplay("avoiding", folder, dtype=dtype).data)
    assert data.shape == (sum(LENGTHS) - len(LENGTHS),)
    begin = 0
    for index, rows in enumerate(LENGTHS):
        with open(folder / f"env_{index:03d}_00.pkl", "rb") as file:
            robot = pickle.load(file)["robot"]
        frames = torch.from_numpy(np.concatenate([robot["des_c_pos"][:, :2], robot["c_pos"][:, :2]], 1))
        part = data[begin : begin + rows - 1]
        assert torch.equal(part["observation"], frames[:-1].to(dtype))
        assert torch.equal(part["next", "observation"], frames[1:].to(dtype))
        assert torch.equal(part["action"], (frames[1:, :2] - frames[:-1, :2]).to(dtype))
        assert torch.equal(part["state"], frames[:-1, 2:].to(dtype))
        assert part["episode"].tolist() == [index] * (rows - 1)
        assert part["step_count"].tolist() == list(range(rows - 1))
        assert part["next", "done"].squeeze(-1).tolist() == [False] * (rows - 2) + [True]
        begin += rows - 1
    assert data["has_action"].all()


def test_load_dataset_and_sampling(folder):
    dataset = load_dataset("d3il:avoiding", root=folder, batch_size=6)
    assert isinstance(dataset, D3ILExperienceReplay)
    assert dataset.sample()["observation"].shape == (6, 4)
    assert len(dataset) == 13
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        dataset.extend(dataset.data)


@pytest.mark.parametrize("inside", ["avoiding/data", "data", "environments/dataset/data/avoiding/data"])
def test_folders_above_the_files(folder, tmp_path, inside):
    shutil.copytree(folder, tmp_path / "d3il" / inside)
    assert len(D3ILExperienceReplay("avoiding", tmp_path / "d3il")) == 13


def test_absent_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match="no folder .*nowhere"):
        D3ILExperienceReplay("avoiding", tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="no demonstrations"):
        D3ILExperienceReplay("avoiding", tmp_path)
    with pytest.raises(ValueError, match="did you mean 'avoiding'"):
        D3ILExperienceReplay("avoidng", tmp_path)


def test_split_files(folder):
    (folder / "train_files.pkl").write_bytes(pickle.dumps(["env_002_00.pkl", "env_000_00.pkl"]))
    assert len(D3ILExperienceReplay("avoiding", folder)) == 13  # the list itself is no demonstration
    dataset = D3ILExperienceReplay("avoiding", folder, split_file="train_files.pkl")
    assert len(dataset) == 12
    assert read_about(dataset.data_path)["notes"]["files"] == ["env_000_00.pkl", "env_002_00.pkl"]
    for names, error, message in (
        (["env_009_00.pkl", "env_000_00.pkl"], FileNotFoundError, "lacks 1 files .*env_009_00"),
        (["../secret.pkl"], ValueError, "no plain file name"),
        ([3], ValueError, "no plain file name"),
        ({"a": 1}, ValueError, "list of file names"),
    ):
        (folder / "eval_files.pkl").write_bytes(pickle.dumps(names))
        with pytest.raises(error, match=message):
            D3ILExperienceReplay("avoiding", folder, split_file=folder / "eval_files.pkl")
    with pytest.raises(FileNotFoundError, match="no split file"):
        D3ILExperienceReplay("avoiding", folder, split_file="absent.pkl")


def test_faults_of_all_files_come_together(folder, cache):
    (folder / "env_003_00.pkl").write_bytes(pickle.dumps(os.system))
    (folder / "env_004_00.pkl").touch()
    write_demo(folder / "env_005_00.pkl", 1)
    write_demo(folder / "env_006_00.pkl", 4, objects=("push-box", "target-box"))
    (folder / "env_007_00.pkl").write_bytes(pickle.dumps({"robot": {"c_pos": np.full((4, 3), np.nan)}}))
    with pytest.raises(RawFolderError) as error:
        D3ILExperienceReplay("avoiding", folder)
    text = str(error.value)
    for part in (
        "003_00.pkl: asks for",
        "004_00.pkl: the file is empty",
        "005_00.pkl: too short",
        "007_00.pkl: missing",
    ):
        assert part in text
    assert "env_006_00.pkl: a demonstration of 'aligning'" in text
    assert len(error.value.problems) == 6
    assert "env_000" not in text
    assert not cache.exists() or not list(cache.rglob("about.json"))


def test_the_cache_is_used_and_follows_the_files(folder, monkeypatch):
    first = D3ILExperienceReplay("avoiding", folder)

    def never(*args, **kwargs):
        raise AssertionError("converted again")

    monkeypatch.setattr(d3il_module, "read_trajectories", never)
    again = D3ILExperienceReplay("avoiding", folder)
    assert again.data_path == first.data_path
    assert (again.data == first.data).all()
    monkeypatch.undo()

    write_demo(folder / "env_001_00.pkl", LENGTHS[1], seed=77)  # same name and size, other content and time
    os.utime(folder / "env_001_00.pkl", ns=(1, 1))
    changed = D3ILExperienceReplay("avoiding", folder, cache=first.data_path_root)
    assert changed.data_path != first.data_path
    assert not torch.equal(changed.data["observation"], first.data["observation"])
    (folder / "env_001_00.pkl").unlink()
    assert len(D3ILExperienceReplay("avoiding", folder)) == 12


@pytest.mark.parametrize("damage", ["about", "truncate", "flip", "missing", "extra"])
def test_a_damaged_cache_is_rebuilt(folder, damage):
    first = D3ILExperienceReplay("avoiding", folder)
    expected = first.data.clone()
    file = first.data_path / "steps" / "action.memmap"
    if damage == "about":
        (first.data_path / "about.json").write_text("{")
    elif damage == "truncate":
        file.write_bytes(file.read_bytes()[:-8])
    elif damage == "flip":
        file.write_bytes(b"\x01" + file.read_bytes()[1:])
    elif damage == "missing":
        file.unlink()
    else:
        (first.data_path / "steps" / "other.pickle").write_bytes(pickle.dumps(os.system))
    with pytest.raises(DamagedDataError):
        load_ted(first.data_path)
    again = D3ILExperienceReplay("avoiding", folder)
    assert (again.data == expected).all()
    load_ted(first.data_path)


def test_a_full_disk_while_converting(folder, cache, monkeypatch):
    def full(self, *args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(TensorDict, "memmap_like", full)
    with pytest.raises(OSError, match="No space left"):
        D3ILExperienceReplay("avoiding", folder)
    assert all(entry.suffix == ".lock" for entry in (cache / "d3il").iterdir())
    monkeypatch.undo()
    assert len(D3ILExperienceReplay("avoiding", folder)) == 13


def test_many_processes_may_convert_at_once(folder, cache):
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        sets = list(pool.map(lambda _: D3ILExperienceReplay("avoiding", folder).data.clone(), range(24)))
    assert all((data == sets[0]).all() for data in sets)
    assert len(list((cache / "d3il").glob("[!.]*"))) == 1


def test_raw_files_are_never_written(folder):
    before = {file.name: (file.read_bytes(), file.stat().st_mtime_ns) for file in folder.iterdir()}
    dataset = D3ILExperienceReplay("avoiding", folder)
    dataset.delete()
    assert not dataset.data_path.exists()
    assert before == {file.name: (file.read_bytes(), file.stat().st_mtime_ns) for file in folder.iterdir()}


def test_label_budget_at_loading(folder):
    dataset = D3ILExperienceReplay("avoiding", folder, label_budget=LabelBudget(1, seed=3))
    hidden = ~dataset.data["has_action"].squeeze(-1)
    assert dataset.label_report.trajectories_touched == 1
    assert dataset.data["action"][hidden].isnan().all()
    assert dataset.data["observation"][hidden][:, :2].isnan().all()
    assert dataset.data["observation"][:, 2:].isfinite().all()
    assert D3ILExperienceReplay("avoiding", folder).data["has_action"].all()  # never part of the cache


def recorded(lengths=(4, 7), dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    return flatten_trajectories(
        [torch.randn(length + 1, 4, generator=generator) for length in lengths],
        [torch.randn(length, 2, generator=generator) for length in lengths],
        dtype=dtype,
    )


def test_from_tensordict():
    data = recorded()
    dataset = D3ILExperienceReplay.from_tensordict(data, "avoiding", batch_size=3, label_budget=LabelBudget(1))
    assert dataset.label_report.total_trajectories == 2
    assert torch.equal(dataset.data["state"], data["observation"][:, 2:])
    assert "state" not in data.keys() and data["has_action"].all()
    assert dataset.sample().shape == (3,)
    with pytest.raises(RuntimeError, match="cache"):
        dataset.delete()
    with pytest.raises(ValueError, match="'action' of task 'avoiding' has 2 columns, the data have 1"):
        D3ILExperienceReplay.from_tensordict(data.clone().set("action", data["action"][:, :1]), "avoiding")
    with pytest.raises(LayoutError):
        D3ILExperienceReplay.from_tensordict(data.exclude("episode"), "avoiding")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_saved_data_sets(tmp_path, dtype):
    data = recorded(dtype=dtype)
    path = save_ted(data, tmp_path / "demos", task="avoiding", notes={"expert": "scripted"})
    loaded = load_ted(path, task="avoiding")
    assert (loaded == data).all() and loaded["action"].dtype == dtype
    assert type(load_ted(path, memmap=False)["action"]) is torch.Tensor
    about = read_about(path)
    assert about["lengths"] == [4, 7] and about["notes"] == {"expert": "scripted"}
    assert about["statistics"]["action"]["mean"] == pytest.approx(data["action"].double().mean(0).tolist())
    assert not [file for file in path.rglob("*") if "pickle" in file.name or file.suffix in (".pkl", ".pt")]

    dataset = D3ILExperienceReplay.from_folder(path, task="avoiding", batch_size=2)
    assert len(dataset) == 11
    with pytest.raises(RuntimeError, match="cache"):
        dataset.delete()
    with pytest.raises(ValueError, match="'avoiding', wanted 'stacking'"):
        load_ted(path, task="stacking")
    save_ted(data[:4], path, task="avoiding")  # replaces the earlier one
    assert load_ted(path).shape == (4,)
    assert [entry.name for entry in tmp_path.iterdir()] == ["demos"]


def test_partially_labelled_data_can_be_saved(tmp_path):
    data, _ = LabelBudget(1).apply(recorded(), command=slice(0, 2))
    loaded = load_ted(save_ted(data, tmp_path / "demos", task="avoiding"))
    assert torch.equal(loaded["action"].isnan(), data["action"].isnan())
    assert torch.equal(loaded["observation"].nan_to_num(7), data["observation"].nan_to_num(7))


def test_save_refuses(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "thesis.txt").write_text("years")
    with pytest.raises(FileExistsError, match="left as it is"):
        save_ted(recorded(), tmp_path / "work")
    assert (tmp_path / "work" / "thesis.txt").read_text() == "years"
    with pytest.raises(TypeError, match="only tensors"):
        save_ted(recorded().set_non_tensor("note", "text"), tmp_path / "other")
    with pytest.raises(LayoutError):
        save_ted(recorded().exclude("action"), tmp_path / "other")
    with pytest.raises(DamagedDataError, match="holds no data set"):
        load_ted(tmp_path / "work")
    assert [entry.name for entry in tmp_path.iterdir()] == ["work"]


def test_flatten_trajectories_checks():
    with pytest.raises(ValueError, match="trajectory 1: .*T - 1"):
        flatten_trajectories([torch.zeros(3, 2), torch.zeros(3, 2)], [torch.zeros(2, 1), torch.zeros(3, 1)])
    with pytest.raises(ValueError, match="trajectory 1 has 1 observation"):
        flatten_trajectories([torch.zeros(3, 2), torch.zeros(3, 1)], [torch.zeros(2, 1), torch.zeros(2, 1)])
    with pytest.raises(ValueError, match="0 trajectories"):
        flatten_trajectories([], [])


@pytest.mark.skipif(not HUMAN.is_dir(), reason=f"the human demonstrations are not at {HUMAN}")
def test_human_demonstrations():
    dataset = D3ILExperienceReplay("avoiding", HUMAN)
    data = validate(dataset.data)
    about = read_about(dataset.data_path)
    assert about["trajectories"] == 24
    assert all(64 <= length <= 103 for length in about["lengths"])
    # commands are joystick steps: what is commanded next is the command plus the action
    assert torch.allclose(data["observation"][:, :2] + data["action"], data["next", "observation"][:, :2], atol=1e-6)
    same = data["episode"][1:] == data["episode"][:-1]
    assert torch.equal(data["next", "observation"][:-1][same], data["observation"][1:][same])
    assert data["action"].abs().max() < 0.03
