# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests data sets on disk: saved data are loaded with their task; damage and code raise errors."""

import json

import pytest
import torch

from torchrl_koap.data import LabelBudget, flatten_trajectories, save_ted, select_state
from torchrl_koap.data.ted import load_ted, read_about, source_names
from torchrl_koap.files import DataError
from torchrl_koap.tasks import get_task

AVOIDING = get_task("avoiding")


def recorded(lengths=(4, 7), dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    return flatten_trajectories(
        [torch.randn(length + 1, 4, generator=generator) for length in lengths],
        [torch.randn(length, 2, generator=generator) for length in lengths],
        dtype=dtype,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_saved_data_sets(tmp_path, dtype):
    data = select_state(recorded(dtype=dtype), AVOIDING.state_of)
    path = save_ted(data, tmp_path / "demos", AVOIDING, notes={"expert": "scripted"})
    loaded, task = load_ted(path)
    assert (loaded == data).all() and loaded["action"].dtype == dtype and task is AVOIDING
    assert set(loaded.keys(True, True)) == set(data.keys(True, True))
    about = read_about(path)
    assert about["lengths"] == [4, 7] and about["notes"] == {"expert": "scripted"}
    assert about["trajectories"] == 2 and about["steps"] == about["labelled_steps"] == 11
    assert sorted(file.name for file in path.iterdir()) == ["about.json", "steps.safetensors"]
    save_ted(data[:4], path, AVOIDING)  # replaces the earlier one
    assert load_ted(path)[0].shape == (4,)
    assert [entry.name for entry in tmp_path.iterdir()] == ["demos"]


def test_partially_labelled_data(tmp_path):
    data, _ = LabelBudget(count=1).apply(recorded(), command=slice(0, 2))
    path = save_ted(data, tmp_path / "demos", AVOIDING)
    loaded, _ = load_ted(path)
    assert torch.equal(loaded["action"].isnan(), data["action"].isnan())
    assert torch.equal(loaded["observation"].nan_to_num(7), data["observation"].nan_to_num(7))


def test_save_refuses(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "thesis.txt").write_text("years")
    with pytest.raises(FileExistsError, match="it was not changed"):
        save_ted(recorded(), tmp_path / "work", AVOIDING)
    with pytest.raises(ValueError, match="`note` is invalid, expected torch.Tensor"):
        save_ted(recorded().set_non_tensor("note", "text"), tmp_path / "other", AVOIDING)
    with pytest.raises(DataError):
        save_ted(recorded().exclude("action"), tmp_path / "other", AVOIDING)
    with pytest.raises(DataError, match="holds no data set"):
        load_ted(tmp_path / "work")
    assert [entry.name for entry in tmp_path.iterdir()] == ["work"]


def change(path, **entries):
    about = json.loads((path / "about.json").read_text())
    (path / "about.json").write_text(json.dumps(about | entries))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: (path / "about.json").write_text("{"), "about.json cannot be used"),
        (lambda path: (path / "about.json").unlink(), "about.json is missing"),
        (lambda path: (path / "steps.safetensors").unlink(), "steps.safetensors cannot be used: it is missing"),
        (
            lambda path: (path / "steps.safetensors").write_bytes(b"1"),
            "steps.safetensors cannot be used: it was changed",
        ),
        (
            lambda path: (path / "steps.safetensors").write_bytes(b"1" * (path / "steps.safetensors").stat().st_size),
            "steps.safetensors cannot be used: it was changed",
        ),
        (lambda path: change(path, format=1), "no description of a data set in format 2"),
        (lambda path: change(path, steps=5), "its entries do not have 5 steps"),
        (lambda path: change(path, lengths="many"), "missing or invalid: lengths"),
        (lambda path: change(path, notes=None), "missing or invalid: notes"),
        (lambda path: change(path, definition={"name": "x"}), "about.json cannot be used: the task is damaged"),
        (lambda path: change(path, definition=AVOIDING.to_json()), "names code in env, expert, .*register it by"),
    ],
)
def test_damage_is_named(damage, message, tmp_path):
    path = save_ted(recorded(), tmp_path / "demos", AVOIDING)
    damage(path)
    with pytest.raises(DataError, match=message):
        load_ted(path)


@pytest.mark.parametrize("sources", [5, None, "run_0.npz", [1, 2], {"a": 1}])
def test_damaged_names_of_sources_are_refused(sources, tmp_path):
    path = save_ted(recorded(), tmp_path / "demos", AVOIDING, notes={"sources": ["a", "b"]})
    assert source_names(path) == ["a", "b"]
    change(path, notes={"sources": sources})
    with pytest.raises(DataError, match="about.json cannot be used: notes.sources must be a list of names"):
        source_names(path)


def test_a_forged_checksum_does_not_let_anything_in(tmp_path):
    from torchrl_koap.files import sha256_of

    path = save_ted(recorded(), tmp_path / "demos", AVOIDING)
    content = (path / "steps.safetensors").read_bytes()
    for forged in (content[:-8], content[:8] + b"[" + content[9:], b"\xff" * 20):
        (path / "steps.safetensors").write_bytes(forged)
        change(path, sha256=sha256_of(path / "steps.safetensors"), bytes=len(forged))
        with pytest.raises(DataError, match="steps.safetensors cannot be used"):
            load_ted(path)
