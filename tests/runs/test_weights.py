# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests weight files: complete, checked when loaded, never damaged by a failed save."""

import pytest
import torch
from torch import nn

from torchrl_koap.modules import Normalizer
from torchrl_koap.runs import weights
from torchrl_koap.runs.weights import CheckpointError, load_tensors, load_weights, save_tensors


class Model(nn.Module):
    """A network with a normaliser that brings its statistics, or waits for them."""

    def __init__(self, *, fitted=True, width=4, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.normalizer = Normalizer.fit(torch.randn(20, 3)) if fitted else Normalizer(3)
        self.layer = nn.Linear(3, width)

    def forward(self, x):
        return self.layer(self.normalizer(x)).square().mean()


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.safetensors"
    model = Model()
    save_tensors(path, model.state_dict(), {"task": "avoiding", "kind": "planner"})
    return path, model


def test_weights_bring_their_statistics(saved):
    path, model = saved
    other = Model(fitted=False, seed=1)
    load_weights(path, other, {"task": "avoiding"})
    x = torch.randn(5, 3)
    assert torch.equal(model(x), other(x))


def test_weights_keep_their_type(tmp_path):
    model, other = Model().double(), Model(seed=1)
    save_tensors(tmp_path / "model", model.state_dict())
    load_weights(tmp_path / "model", other, {})
    assert other.layer.weight.dtype == torch.float64 and torch.equal(other.layer.weight, model.layer.weight)


def test_files_of_tensors_have_the_usual_permissions(tmp_path):
    (tmp_path / "plain").touch()
    save_tensors(tmp_path / "tensors", {"x": torch.zeros(2)})
    assert (tmp_path / "tensors").stat().st_mode == (tmp_path / "plain").stat().st_mode


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
        load_weights(path, Model(fitted=False), {"task": "avoiding"})
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_another_task_or_none_is_refused(saved):
    path, model = saved
    with pytest.raises(CheckpointError, match="trained on task 'avoiding', not on 'sorting'"):
        load_weights(path, model, {"task": "sorting"})
    save_tensors(path, model.state_dict())
    with pytest.raises(CheckpointError, match="trained on task None, not on 'avoiding'"):
        load_weights(path, model, {"task": "avoiding"})


@pytest.mark.parametrize("length", [0, 4, 40, -1])
def test_truncated_files_are_named(saved, length):
    path, model = saved
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(CheckpointError, match=f"{path} is damaged"):
        load_weights(path, model, {"task": "avoiding"})


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(CheckpointError, match="nothing.safetensors is missing"):
        load_tensors(tmp_path / "nothing.safetensors")
    with pytest.raises(CheckpointError, match="is missing"):
        load_tensors(tmp_path)
    (tmp_path / "text").write_text("no weights at all, but long enough for a header")
    with pytest.raises(CheckpointError, match="is damaged"):
        load_tensors(tmp_path / "text")
    weights.save_file({"x": torch.ones(1)}, tmp_path / "facts", metadata={"about": "[1]"})
    with pytest.raises(CheckpointError, match="its header entry .about. must be an object"):
        load_tensors(tmp_path / "facts")


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
