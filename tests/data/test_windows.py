# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows stay inside their trajectory, are padded by its ends, and are stored rows."""

import pytest
import torch
from counted_windows import LENGTHS, demonstrations, seen
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.data import TensorDictReplayBuffer

from torchrl_koap.data import LabelBudget, WindowTable, cut_windows, make_window_buffer
from torchrl_koap.data.windows import spread_evenly

GPU = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))


def by_hand(lengths, window, before=0, after=0):
    """(trajectory, [step of every frame]) of every window, by the definition."""
    found = []
    for trajectory, length in enumerate(lengths):
        for start in range(-before, length + after - window + 1):
            found.append((trajectory, tuple(min(max(start + j, 0), length - 1) for j in range(window))))
    return found


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=6), st.integers(3, 6), st.integers(0, 5), st.integers(0, 5))
def test_the_table_holds_every_window_once(lengths, window, before, after):
    data, pads = demonstrations(lengths), {"pad_before": min(before, window - 1), "pad_after": min(after, window - 1)}
    if any(length + sum(pads.values()) < window for length in lengths):
        with pytest.raises(ValueError, match="shorter than a window"):
            WindowTable.build(data, window, **pads)
        return
    table = WindowTable.build(data, window, **pads)
    frames, padded = table.frames()
    assert seen(data[frames]) == by_hand(lengths, window, *pads.values())
    repeated = torch.zeros_like(padded)
    for row, start in enumerate(table.starts.tolist()):
        for frame in range(window):
            repeated[row, frame] = not table.first[row] <= start + frame <= table.last[row]
    assert torch.equal(padded, repeated)
    some = torch.arange(len(table.starts)) % 3 == 1
    assert torch.equal(table.frames(some)[0], frames[some])


@pytest.mark.parametrize("pad_before", [0, 2])
def test_all_windows_at_once(pad_before):
    data = demonstrations((9, 5, 12))
    cut = cut_windows(data, 5, select=["observation"], pad_before=pad_before)
    assert set(cut.keys()) == {"observation", "padded"} and cut["padded"].shape == (*cut.shape, 1)
    frames, padded = WindowTable.build(data, 5, pad_before=pad_before).frames()
    assert torch.equal(cut["observation"], data["observation"][frames])
    assert torch.equal(cut["padded"].squeeze(-1), padded) and padded.any() == bool(pad_before)


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


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 8), st.integers(1, 10), st.integers(0, 3), st.integers(0, 5), st.sampled_from((0, 1, 3)))
def test_labelled_windows_by_the_definition(seed, number, before, after, counted):
    lengths, window = (9, 14, 7), 6
    data, _ = LabelBudget(count=number, unit="transition", seed=seed).apply(demonstrations(lengths))
    table = WindowTable.build(
        data, window, counted=range(counted, 5 - counted // 2), pad_before=before, pad_after=after
    )
    has_action = data["has_action"].squeeze(-1)
    expected = []
    for begin, first, last in zip(table.starts.tolist(), table.first.tolist(), table.last.tolist(), strict=True):
        inner = [begin + frame for frame in range(counted, 5 - counted // 2)]
        expected.append(any(first <= row and row + 1 <= last and bool(has_action[row]) for row in inner))
    assert table.labelled.tolist() == expected


def test_wrong_options():
    data = demonstrations()
    for counted in (range(1, 16), range(-1, 4)):
        with pytest.raises(ValueError, match=r"all but the last may count: got 16 and range"):
            WindowTable.build(data, 16, counted=counted)
    with pytest.raises(ValueError, match="a window has 2 frames or more"):
        cut_windows(data, 1)
    with pytest.raises(ValueError, match=r"pad_before must be in 0\.\.15"):
        make_window_buffer(data, 16, 4, pad_before=16)
    with pytest.raises(KeyError, match="no entries"):
        make_window_buffer(data, 16, 4, select=["observation", "states"])
    with pytest.raises(KeyError, match="windows need the entry 'episode'"):
        make_window_buffer(data.exclude("episode"), 16, 4)
    with pytest.raises(ValueError, match="flat data"):
        make_window_buffer(demonstrations((20, 20)).reshape(2, 20), 16, 4)
    with pytest.raises(ValueError, match="of a batch of 4 is no window"):
        make_window_buffer(data, 16, 4, labelled_share=0.1)


def test_short_trajectories_are_named():
    data = demonstrations((20, 15, 16, 3))
    with pytest.raises(ValueError, match=r"2 of 4 trajectories .*\(16 steps\): 1 \(15 steps\), 3 \(3 steps\)"):
        make_window_buffer(data, 16, 4)
    make_window_buffer(demonstrations((15,)), 16, 1, pad_before=1)


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_batches_live_with_the_data(device):
    batch = make_window_buffer(demonstrations().to(device), 16, 4, labelled_share=0.5).sample()
    assert batch["action"].device.type == device
    assert set(seen(batch)) <= set(by_hand(LENGTHS, 16))


def test_steps_of_one_trajectory_must_be_consecutive():
    data = demonstrations((40,))
    keep = torch.cat([torch.arange(0, 20), torch.arange(22, 40)])
    table = WindowTable.build(data[keep], 16)
    assert table.starts.tolist() == [0, 1, 2, 3, 4, 20, 21, 22]


def test_rows_are_taken_evenly_from_the_first_to_the_last():
    rows = torch.arange(10)
    assert spread_evenly(rows, 4).tolist() == [0, 3, 6, 9]
    assert spread_evenly(rows, 10) is rows and len(spread_evenly(rows[:0], 4)) == 0
