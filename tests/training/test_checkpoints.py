# This source code is licensed under the MIT license found in the LICENSE file.
"""Weights and training states: complete, refused when they do not fit, never damaged by a failed save."""

from __future__ import annotations

import errno
import hashlib
import json
import os

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from torchrl_koap.modules import Normalizer
from torchrl_koap.training import checkpoints
from torchrl_koap.training.checkpoints import (
    CheckpointError,
    load_tensors,
    load_training_state,
    load_weights,
    save_tensors,
    save_training_state,
    save_weights,
)


class Model(nn.Module):
    """A network with a normaliser that brings its statistics, or waits for them."""

    def __init__(self, *, fitted=True, width=4, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.normalizer = Normalizer.fit(torch.randn(20, 3)) if fitted else Normalizer()
        self.layer = nn.Linear(3, width)

    def forward(self, x):
        return self.layer(self.normalizer(x)).square().mean()


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.safetensors"
    model = Model()
    save_weights(path, model, {"task": "avoiding", "kind": "planner"})
    return path, model


def test_weights_bring_their_statistics(saved):
    path, model = saved
    other = Model(fitted=False, seed=1)
    assert load_weights(path, other, task="avoiding") == {"task": "avoiding", "kind": "planner"}
    x = torch.randn(5, 3)
    assert torch.equal(model(x), other(x))


def test_parts_of_one_storage_and_odd_layouts_are_saved(tmp_path):
    base = torch.arange(12.0).reshape(3, 4)
    save_tensors(tmp_path / "a", {"row": base[1], "transposed": base.T, "same": base, "empty": base[:0]})
    tensors, about = load_tensors(tmp_path / "a")
    assert torch.equal(tensors["row"], base[1]) and torch.equal(tensors["transposed"], base.T)
    assert tensors["empty"].shape == (0, 4) and about == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("normalizer.offset"), r"does not fit the model: Missing key\(s\).*\"normalizer.offset\""),
        (lambda t: t.update(extra=torch.ones(1)), 'does not fit the model: Unexpected key.*"extra"'),
        (lambda t: t.update({"layer.bias": torch.ones(7)}), r"size mismatch for layer.bias.*\[7\]"),
    ],
)
def test_weights_that_do_not_fit_are_refused_in_one_line(saved, change, message):
    path, _ = saved
    tensors, about = load_tensors(path)
    change(tensors)
    save_tensors(path, tensors, about)
    with pytest.raises(CheckpointError, match=message) as error:
        load_weights(path, Model(fitted=False), task="avoiding")
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_another_task_or_none_is_refused(saved):
    path, model = saved
    with pytest.raises(CheckpointError, match="trained on task 'avoiding', not on 'sorting'"):
        load_weights(path, model, task="sorting")
    save_tensors(path, model.state_dict())
    with pytest.raises(CheckpointError, match="trained on task None, not on 'avoiding'"):
        load_weights(path, model, task="avoiding")


@pytest.mark.parametrize("length", [0, 4, 40, -1])
def test_truncated_files_are_named(saved, length):
    path, model = saved
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(CheckpointError, match=f"{path} is damaged"):
        load_weights(path, model, task="avoiding")


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(CheckpointError, match="nothing.safetensors is missing"):
        load_tensors(tmp_path / "nothing.safetensors")
    with pytest.raises(CheckpointError, match="is missing"):
        load_tensors(tmp_path)
    (tmp_path / "text").write_text("no weights at all, but long enough for a header")
    with pytest.raises(CheckpointError, match="is damaged"):
        load_tensors(tmp_path / "text")
    checkpoints.save_file({"x": torch.ones(1)}, tmp_path / "facts", metadata={"about": "[1]"})
    with pytest.raises(CheckpointError, match="its facts are no object"):
        load_tensors(tmp_path / "facts")


@pytest.mark.parametrize("place", ["writing", "renaming"])
def test_a_full_disk_leaves_what_was_there(saved, monkeypatch, place):
    path, _ = saved
    before = path.read_bytes()

    def half_written(tensors, file, metadata):
        with open(file, "wb") as stream:
            stream.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device", str(file))

    def no_rename(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    if place == "writing":
        monkeypatch.setattr(checkpoints, "save_file", half_written)
    else:
        monkeypatch.setattr(os, "replace", no_rename)
    with pytest.raises(OSError, match="No space left"):
        save_weights(path, Model(seed=3), {"task": "avoiding"})
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def train_a_little(model, optimizer, steps):
    for _ in range(steps):
        model(torch.randn(6, 3)).backward()
        optimizer.step()
        optimizer.zero_grad()


def make_optimizer(model):
    return torch.optim.AdamW(model.parameters(), 1e-2, weight_decay=0.1, fused=True)


def test_a_training_goes_on_bit_for_bit(tmp_path):
    """Weights, moments, step counts, learning rate and random numbers: all of them come back."""
    model = Model()
    optimizer = make_optimizer(model)
    torch.manual_seed(5)
    train_a_little(model, optimizer, 3)
    optimizer.param_groups[0]["lr"] = 3e-3
    save_training_state(tmp_path / "state", model, optimizer, {"phase": "x", "step": 3})
    train_a_little(model, optimizer, 4)

    other = Model(seed=8)
    other_optimizer = make_optimizer(other)
    torch.manual_seed(6)
    assert load_training_state(tmp_path / "state", other, other_optimizer) == {"phase": "x", "step": 3}
    assert other_optimizer.param_groups[0]["lr"] == 3e-3
    train_a_little(other, other_optimizer, 4)
    for name, value in model.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            assert torch.equal(value, other_optimizer.state_dict()["state"][index][name]), name


def test_a_state_of_another_model_or_none_at_all_is_refused(tmp_path):
    model = Model()
    save_training_state(tmp_path / "state", model, make_optimizer(model), {"step": 1})
    other = Model(width=5)
    before = {name: value.clone() for name, value in other.state_dict().items()}
    with pytest.raises(CheckpointError, match="holds the state of another model"):
        load_training_state(tmp_path / "state", other, make_optimizer(other))
    assert all(torch.equal(value, before[name]) for name, value in other.state_dict().items())
    save_weights(tmp_path / "weights", model, {"task": "avoiding"})
    with pytest.raises(CheckpointError, match="is no state of a training"):
        load_training_state(tmp_path / "weights", model, make_optimizer(model))


def test_no_bit_of_the_header_can_change_unseen(tmp_path):
    """The facts, a training's step among them, are as precious as the tensors."""
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"x": torch.ones(1)}, {"step": 24, "lr": [1e-05, 0.5], "phase": "planner"})
    whole = path.read_bytes()
    for place in range(len(whole)):
        broken = bytearray(whole)
        broken[place] ^= 1 << (place % 7)
        path.write_bytes(broken)
        with pytest.raises(CheckpointError, match="a.safetensors"):
            load_tensors(path)


def test_checksums_of_before_are_of_the_tensors_alone(tmp_path):
    path, tensors = tmp_path / "a.safetensors", {"x": torch.ones(2)}
    content = hashlib.sha256(b"x torch.float32 [2]" + tensors["x"].numpy().tobytes()).hexdigest()
    for facts in ({"step": 3, "sha256": content}, {"step": 3}):
        save_file(tensors, path, metadata={"about": json.dumps(facts)})
        assert load_tensors(path)[1] == {"step": 3}
    save_file(tensors, path)
    assert load_tensors(path)[1] == {}
    save_file(tensors, path, metadata={"about": json.dumps({"step": 3, "sha256": content[::-1]})})
    with pytest.raises(CheckpointError, match="checksum"):
        load_tensors(path)
