# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the validator accepts the layout and names all departures from it in one error."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.files import DataError
from torchrl_koap.keys import REQUIRED, validate
from torchrl_koap.modules import (
    KoopmanLifting,
    KoopmanOperator,
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LinearActionDecoder,
)
from torchrl_koap.modules.koopman.compact_lifting import CompactLifting


def flat(lengths=(3, 1, 4), dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    frames = [torch.randn(length + 1, 4, generator=generator) for length in lengths]
    actions = [torch.randn(length, 2, generator=generator) for length in lengths]
    return flatten_trajectories(frames, actions, dtype=dtype)


def problems(data, **kwargs):
    with pytest.raises(DataError) as error:
        validate(data, **kwargs)
    assert all(problem in str(error.value) for problem in error.value.problems)
    return error.value.problems


@pytest.mark.parametrize("lengths", [(3, 1, 4), (1,), (1, 1), (7,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_layout_is_accepted_and_unchanged(lengths, dtype):
    data = flat(lengths, dtype=dtype)
    copy = data.clone()
    assert validate(data) is data
    assert (data == copy).all()
    data["state"] = data["observation"][:, 2:]
    data["next", "reward"] = torch.zeros(data.shape[0], 1)
    data["action"][1:] = float("nan")
    data["has_action"][1:] = False
    validate(data)


@pytest.mark.parametrize("key", REQUIRED)
def test_missing_keys(key):
    assert problems(flat().exclude(key)) == [f"missing key {key!r}"]


def test_everything_is_reported_at_once():
    data = flat().exclude("action", ("next", "done"))
    data["episode"] = data["episode"].float()
    data["has_action"] = data["has_action"].squeeze(-1)
    data["label_command"] = torch.zeros(len(data))
    found = problems(data)
    assert len(found) == 5 and "'label_command' must be a float tensor [N, d], got torch.float32 [8]" in found
    assert any("int64" in problem for problem in found) and any("[N, 1]" in problem for problem in found)


def test_batch_size():
    assert "flat over steps" in problems(flat().reshape(2, 4))[0]
    assert "no steps" in problems(flat()[:0])[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: d["observation"][5].fill_(float("nan")),
            "'observation' is NaN or infinite in 1 steps, first at step 5",
        ),
        (lambda d: d["next", "observation"][2, 1].fill_(float("inf")), "('next', 'observation') is NaN"),
        (lambda d: d["action"][2].fill_(float("nan")), "a labelled 'action' is not finite in 1 steps, first at step 2"),
        (lambda d: d["has_action"][3].fill_(False), "outside the label budget must be NaN"),
        (
            lambda d: d["step_count"][1].fill_(7),
            "'step_count' does not count 0, 1, 2, ... in its trajectory in 2 steps, first at step 1",
        ),
        (lambda d: d["step_count"][3].fill_(1), "first at step 3"),
        (lambda d: d["episode"][-1].fill_(0), "one after the other"),
        (lambda d: d["next", "done"][2].fill_(False), "False at the end of a trajectory in 1 steps, first at step 2"),
        (lambda d: d["next", "done"][0].fill_(True), "True inside a trajectory in 1 steps, first at step 0"),
        (lambda d: d["next", "truncated"][0].fill_(True), "terminated or truncated"),
    ],
)
def test_wrong_values(change, message):
    data = flat()
    change(data)
    assert any(message in problem for problem in problems(data))


def test_widths_must_agree():
    data = flat()
    data["next", "observation"] = data["next", "observation"][:, :3].clone()
    assert problems(data) == ["'observation' has 4 columns, ('next', 'observation') has 3"]


def test_an_unlabelled_action_that_is_partly_nan_is_a_fault():
    data = flat()
    data["action"][1, 0] = float("nan")
    data["has_action"][1] = False
    assert any("unlabelled" in problem for problem in problems(data))


def test_blanked_commands():
    data = flat()
    data["observation"][:4, 0:2] = float("nan")
    data["next", "observation"][:4, 0:2] = float("nan")
    validate(data, command=slice(0, 2))
    assert len(problems(data)) == 2
    data["observation"][6, 1] = float("nan")  # half a command is a fault
    data["observation"][7, 3] = float("nan")
    assert "in 2 steps, first at step 6" in problems(data, command=slice(0, 2))[0]


@pytest.mark.parametrize(
    ("part", "entry"),
    [
        (KoopmanLifting(2, 4), "state"),
        (CompactLifting(2, 2), "state"),
        (KoopmanOperator(4), "lifted_state"),
        (LatentActionMLP(2, 4), "state"),
        (LinearActionDecoder(4, 2), "latent_action"),
    ],
)
def test_every_part_names_the_entry_that_it_lacks(part, entry):
    with pytest.raises(
        KeyError, match=rf"{type(part).__name__} reads '{entry}'; there are .*'robot', 'window'.*in_key"
    ):
        part(TensorDict({"robot": {"window": torch.zeros(3, 16, 2)}}, [3]))


@pytest.mark.parametrize(
    ("kind", "sizes"),
    [
        (KoopmanLifting, (2, 4)),
        (CompactLifting, (24, 2)),
        *((kind, (2, 6)) for kind in (LatentActionMLP, LatentActionLSTM, LatentActionFourier)),
        (LinearActionDecoder, (6, 2)),
    ],
)
def test_every_part_reads_and_writes_the_entries_that_it_is_told(kind, sizes):
    part = kind(*sizes, in_key=("agent", "x"), out_key=("agent", "z"))
    written = TensorDictSequential(part)(TensorDict({"agent": {"x": torch.randn(3, 16, sizes[0])}}, [3]))
    assert written["agent", "z"].shape[:2] == (3, 16)
    assert part.in_keys == [("agent", "x")] and part.out_keys == [("agent", "z")]
