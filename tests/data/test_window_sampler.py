# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows stay inside their trajectory, are equally likely, and hold the promised labels."""

from __future__ import annotations

import pytest
import torch
from counted_windows import LENGTHS, demonstrations, seen
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer, TensorStorage

from torchrl_koap.data import (
    D3ILExperienceReplay,
    LabelBudget,
    WindowSampler,
    WindowSamplerWithoutReplacement,
    WindowTable,
    WindowUnit,
    flatten_trajectories,
    make_window_buffer,
    save_ted,
)
from torchrl_koap.tasks import get_task

GPU = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))


def by_hand(lengths, window, before=0, after=0):
    """(trajectory, [step of every frame]) of every window, by the definition."""
    found = []
    for trajectory, length in enumerate(lengths):
        for start in range(-before, length + after - window + 1):
            found.append((trajectory, tuple(min(max(start + j, 0), length - 1) for j in range(window))))
    return found


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 12), min_size=1, max_size=6),
    st.integers(3, 6),
    st.integers(0, 5),
    st.integers(0, 5),
    st.data(),
)
def test_one_epoch_is_every_window_once(lengths, window, before, after, data):
    before, after = min(before, window - 1), min(after, window - 1)
    expected = by_hand(lengths, window, before, after)
    arguments = {"pad_before": before, "pad_after": after, "short": "drop", "replacement": False, "drop_last": False}
    if not expected:
        with pytest.raises(ValueError, match="shorter than a window"):
            make_window_buffer(demonstrations(lengths), window, 4, **arguments)
        return
    too_short = any(n + before + after < window for n in lengths)
    batch_size = data.draw(st.integers(1, 7))
    if too_short:
        with pytest.warns(UserWarning, match="left out"):
            buffer = make_window_buffer(demonstrations(lengths), window, batch_size, **arguments)
    else:
        buffer = make_window_buffer(demonstrations(lengths), window, batch_size, **arguments)
    for _ in range(2):
        batches = list(buffer)
        assert sorted(w for batch in batches for w in seen(batch)) == sorted(expected)
        assert {len(batch) for batch in batches[:-1]} <= {batch_size}


@pytest.mark.parametrize(
    ("size", "drop_last", "sizes"),
    [(7, True, [7] * 7), (7, False, [7] * 7), (20, True, [20, 20]), (20, False, [20, 20, 9]), (49, True, [49])],
)
def test_epoch_lengths(size, drop_last, sizes):
    buffer = make_window_buffer(demonstrations(), 16, size, replacement=False, drop_last=drop_last)
    for _ in range(2):
        assert [len(batch) for batch in buffer] == sizes  # 5 + 18 + 1 + 25 = 49 windows


def test_a_batch_larger_than_an_epoch():
    with pytest.raises(ValueError, match="50 different windows, there are 49"):
        make_window_buffer(demonstrations(), 16, 50, replacement=False)
    assert len(make_window_buffer(demonstrations(), 16, 50, replacement=False, drop_last=False).sample()) == 49


def test_windows_are_equally_likely():
    torch.manual_seed(0)
    data = demonstrations((16, 116))
    buffer = make_window_buffer(data, 16, 20_400, select=["observation"])
    counts = torch.zeros(102)
    for trajectory, steps in seen(buffer.sample()):
        counts[0 if trajectory == 0 else 1 + steps[0]] += 1
    # 102 windows, 200 expected each: chi-squared with 101 degrees of freedom is below 150 in 99.9 %
    assert ((counts - 200) ** 2 / 200).sum() < 150


@pytest.mark.parametrize("padded", [False, True])
def test_samples_are_the_stored_rows(padded):
    data = demonstrations()
    options = {"pad_before": 1, "pad_after": 4} if padded else {}
    buffer = make_window_buffer(data, 16, 64, **options)
    for key, value in buffer.sample().items(True, True):
        assert value.shape[:2] == (64, 16), key
    batch, info = buffer.sample(return_info=True)
    for key in data.keys(True, True):
        assert torch.equal(batch[key], data[key][info["index"]])
    assert isinstance(buffer, TensorDictReplayBuffer) == padded


def test_padding():
    buffer = make_window_buffer(demonstrations((5, 9)), 4, 500, pad_before=1, pad_after=2)
    torch.manual_seed(1)
    batch = buffer.sample()
    windows = seen(batch)
    assert set(windows) == set(by_hand((5, 9), 4, 1, 2))
    assert (0, (0, 0, 1, 2)) in windows and (1, (7, 8, 8, 8)) in windows
    for (_, steps), padded in zip(windows, batch["padded"], strict=True):
        expected = [False] * 4
        if steps[0] == steps[1] == 0:
            expected[0] = True
        for frame in range(1, 4):
            expected[frame] = steps[frame] == steps[frame - 1] and steps[frame] > 0
        assert padded.tolist() == expected


def test_the_rollout_start_is_a_window():
    """A rollout begins with its first observation twice: with history 2 that is one padded frame before."""
    table = WindowTable.build(demonstrations((20,)), 16, pad_before=1)
    assert table.starts.tolist() == [-1, 0, 1, 2, 3, 4]
    index, info = WindowUnit(16).expand(
        table.starts[:1], {"window_first": table.first[:1], "window_last": table.last[:1]}, None
    )
    assert index[0].tolist() == [0, *range(15)]
    assert info["padded"][0].tolist() == [True] + [False] * 15
    assert set(info) == {"padded"}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 8), st.integers(1, 10), st.integers(0, 3), st.integers(0, 5), st.integers(1, 3))
def test_labelled_windows_by_the_definition(seed, number, before, after, history):
    lengths, window = (9, 14, 7), 6
    data, _ = LabelBudget(number, "transition", seed=seed).apply(demonstrations(lengths))
    table = WindowTable.build(data, window, history=history, pad_before=before, pad_after=after)
    has_action = data["has_action"].squeeze(-1)
    expected = []
    for start, first, last in zip(table.starts.tolist(), table.first.tolist(), table.last.tolist(), strict=True):
        inner = [start + frame for frame in range(history - 1, window - 1)]
        expected.append(any(first <= row and row + 1 <= last and bool(has_action[row]) for row in inner))
    assert table.labelled.tolist() == expected


@pytest.mark.parametrize(
    ("share", "size", "number"), [(0.25, 16, 4), (0.5, 5, 3), (0.1, 7, 1), (1.0, 8, 8), (0.9, 4, 4)]
)
@pytest.mark.parametrize("replacement", [True, False])
def test_every_batch_holds_its_share(share, size, number, replacement):
    data, _ = LabelBudget(1, "trajectory", seed=2).apply(demonstrations())  # the longest: 25 windows of 49
    buffer = make_window_buffer(data, 16, size, labelled_share=share, replacement=replacement)
    for _ in range(12):
        batch = buffer.sample()
        inner = batch["has_action"][:, 1:15].any(1).squeeze(-1)
        assert inner.tolist() == [True] * number + [False] * (size - number)


def test_stratified_epochs():
    data, _ = LabelBudget(1, "trajectory", seed=1).apply(demonstrations())
    table = WindowTable.build(data, 16)
    free = int((~table.labelled).sum())
    buffer = make_window_buffer(data, 16, 8, labelled_share=0.25, replacement=False, drop_last=False)
    windows = [w for batch in buffer for w in seen(batch)[2:]]
    assert len(windows) == free == len(set(windows))
    labelled = [w for batch in buffer for w in seen(batch)[:2]]
    assert set(labelled) == set(by_hand(LENGTHS, 16)) - set(windows)


def test_fully_labelled_data_have_no_other_pool():
    buffer = make_window_buffer(demonstrations(), 16, 8, labelled_share=0.25, replacement=False)
    assert len({w for batch in buffer for w in seen(batch)[2:]}) == 48


def test_wrong_options():
    data, _ = LabelBudget(1).apply(demonstrations())
    data["has_action"].fill_(False)
    with pytest.raises(ValueError, match="none of the 49 windows has a label"):
        make_window_buffer(data, 16, 8, labelled_share=0.25)
    with pytest.raises(ValueError, match="of a batch of 4 is no window"):
        make_window_buffer(demonstrations(), 16, 4, labelled_share=0.1)
    for wrong in (0, -0.1, 1.1):
        with pytest.raises(ValueError, match="labelled_share"):
            WindowSampler(16, labelled_share=wrong)
    with pytest.raises(ValueError, match="history 16 and window 16"):
        WindowSampler(16, history=16)
    with pytest.raises(ValueError, match=r"pad_before must be in 0\.\.15"):
        WindowSampler(16, pad_before=16)
    with pytest.raises(ValueError, match="'error' or 'drop'"):
        WindowSampler(16, short="ignore")
    with pytest.raises(KeyError, match="no entries"):
        make_window_buffer(demonstrations(), 16, 4, select=["observation", "states"])
    with pytest.raises(KeyError, match="windows need the entry 'episode'"):
        make_window_buffer(demonstrations().exclude("episode"), 16, 4)
    with pytest.raises(ValueError, match="flat data"):
        make_window_buffer(demonstrations((20, 20)).reshape(2, 20), 16, 4)


def test_short_trajectories_are_named():
    data = demonstrations((20, 15, 16, 3))
    with pytest.raises(ValueError, match=r"2 of 4 trajectories .*\(16 steps\): 1 \(15 steps\), 3 \(3 steps\)"):
        make_window_buffer(data, 16, 4)
    with pytest.warns(UserWarning, match="2 of 4 .*left out"):
        buffer = make_window_buffer(data, 16, 4, short="drop")
    assert {w[0] for w in seen(buffer.sample(200))} == {0, 2}
    with pytest.raises(ValueError, match="2 of 2"):
        make_window_buffer(demonstrations((3, 4)), 16, 4, short="drop")
    make_window_buffer(demonstrations((15,)), 16, 1, pad_before=1)


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("kind", ["tensor", "lazy", "memmap"])
def test_storages(kind, device, tmp_path):
    data = demonstrations().to(device)
    if kind == "tensor":
        storage = TensorStorage(data)
    elif kind == "lazy":
        storage = LazyTensorStorage(500, device=device)
    else:
        storage = LazyMemmapStorage(500, scratch_dir=tmp_path, device=device)
    sampler = WindowSampler(16, labelled_share=0.5)
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, sample_unit=sampler.unit(), batch_size=32)
    if kind in ("lazy", "memmap"):
        buffer.extend(data)
    batch = buffer.sample()
    assert batch["observation"].device.type == device
    assert set(seen(batch)) <= set(by_hand(LENGTHS, 16))


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_indices_live_with_the_data(device):
    buffer = make_window_buffer(demonstrations(), 16, 4, device=device, labelled_share=0.5)
    batch, info = buffer.sample(return_info=True)
    assert info["index"].device.type == device == batch["action"].device.type


def test_the_table_follows_the_storage():
    sampler = WindowSampler(16)
    buffer = ReplayBuffer(storage=LazyTensorStorage(60), sampler=sampler, sample_unit=sampler.unit(), batch_size=300)
    buffer.extend(demonstrations((20,)))
    assert {w[0] for w in seen(buffer.sample())} == {0}
    more = demonstrations((20, 20, 20))[20:]
    buffer.extend(more)
    assert {w[0] for w in seen(buffer.sample())} == {0, 1, 2}
    last = demonstrations((20, 20, 20, 10))[60:]
    buffer.extend(last)  # writes over the first half of trajectory 0, whose rest is too short
    with pytest.raises(ValueError, match=r"3 \(10 steps\), 0 \(10 steps\)"):
        buffer.sample()


def test_steps_of_one_trajectory_must_be_consecutive():
    data = demonstrations((40,))
    keep = torch.cat([torch.arange(0, 20), torch.arange(22, 40)])
    table = WindowTable.build(data[keep], 16)
    assert table.starts.tolist() == [0, 1, 2, 3, 4, 20, 21, 22]


def test_a_table_of_other_data_is_refused():
    table = WindowTable.build(demonstrations(), 16)
    sampler = WindowSampler(16, table=table)
    buffer = ReplayBuffer(storage=TensorStorage(demonstrations((20,))), sampler=sampler, sample_unit=sampler.unit())
    with pytest.raises(ValueError, match="109 steps, the storage has 20"):
        buffer.sample(2)


def test_from_a_data_set(tmp_path):
    folder = save_ted(demonstrations(), tmp_path / "ted", get_task("avoiding"))
    dataset = D3ILExperienceReplay("avoiding", folder, label_budget=LabelBudget(2))
    buffer = make_window_buffer(dataset, 16, 8, select=["state", "action"], labelled_share=0.5)
    batch = buffer.sample()
    assert set(batch.keys()) == {"state", "action"}
    assert batch["action"][:4, 1:15].isfinite().all() and batch["action"][4:].isnan().all()


def test_without_replacement_is_shuffled_anew():
    buffer = WindowSamplerWithoutReplacement(16)
    assert not buffer.ran_out
    torch.manual_seed(0)
    buffer = make_window_buffer(demonstrations(), 16, 49, replacement=False)
    assert seen(buffer.sample()) != seen(buffer.sample())


@pytest.mark.parametrize("padding", [{}, {"pad_before": 1}])
def test_threads_may_draw_ahead(padding):
    data = flatten_trajectories([torch.rand(21, 4)] * 3, [torch.rand(20, 2)] * 3)
    buffer = make_window_buffer(data, 16, 5, prefetch=2, select=["episode", "step_count"], **padding)
    for _ in range(8):
        batch = buffer.sample()
        assert batch.shape == (5, 16) and (batch["episode"] == batch["episode"][:, :1]).all()
        assert (batch["step_count"].diff(dim=-1)[:, 1:] == 1).all()


def test_epochs_are_not_drawn_ahead():
    data = flatten_trajectories([torch.rand(21, 4)] * 3, [torch.rand(20, 2)] * 3)
    with pytest.raises(ValueError, match=r"an epoch \(replacement=False\) cannot be prefetched, got prefetch=2"):
        make_window_buffer(data, 16, 5, prefetch=2, replacement=False)
    with pytest.raises(ValueError, match="prefetch must be >= 1, got prefetch=0"):
        make_window_buffer(data, 16, 5, prefetch=0)
