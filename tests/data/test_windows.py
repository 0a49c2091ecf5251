# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests windows: they stay inside their trajectory, are padded by its ends, and are sampled as documented."""

import pytest
import torch
from counted_windows import LENGTHS, demonstrations, seen
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torchrl.data import TensorDictReplayBuffer

from torchrl_koap.data import LabelBudget, WindowSampler, WindowTable, cut_windows, make_window_buffer
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


def test_some_windows_are_spread_evenly_over_all():
    data = demonstrations((9, 5))
    every = cut_windows(data, 4, pad_before=1)
    some = cut_windows(data, 4, pad_before=1, most=4)
    assert len(every) == 10 and (some == every[[0, 3, 6, 9]]).all()
    assert (cut_windows(data, 4, pad_before=1, most=99) == every).all()


@pytest.mark.parametrize("options", [{}, {"pad_before": 1}, {"pad_after": 4}, {"pad_before": 1, "pad_after": 4}])
def test_samples_are_the_stored_rows(options):
    data = demonstrations()
    buffer = make_window_buffer(data, 16, 64, **options)
    for key, value in buffer.sample().items(True, True):
        assert value.shape[:2] == (64, 16), key
    batch, info = buffer.sample(return_info=True)
    for key in data.keys(True, True):
        assert torch.equal(batch[key], data[key][info["index"]])
    assert isinstance(buffer, TensorDictReplayBuffer) == ("padded" in batch.keys()) == bool(options)


@settings(max_examples=40, deadline=None)
@example(0, 30, 5, 0, 3)  # windows whose counted frames all lie before the data
@given(st.integers(0, 8), st.integers(1, 10), st.integers(0, 5), st.integers(0, 5), st.sampled_from((0, 1, 3)))
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


def test_labels_on_inner_frames_count_by_default():
    data = demonstrations((16, 16))
    data["has_action"] = torch.isin(data["step_count"], torch.tensor([0, 15])).unsqueeze(-1)
    assert not WindowTable.build(data, 16).labelled.any()
    data["has_action"][[1, 30]] = True
    assert WindowTable.build(data, 16).labelled.all()


def test_steps_may_be_counted_as_torchrl_does():
    data = demonstrations()
    counted = data.copy().set("step_count", data["step_count"].unsqueeze(-1))
    assert torch.equal(WindowTable.build(counted, 16).starts, WindowTable.build(data, 16).starts)


def test_wrong_options():
    data = demonstrations()
    for counted in (range(1, 16), range(-1, 4)):
        with pytest.raises(ValueError, match=r"counted exclude the last frame, got 16 and range"):
            WindowTable.build(data, 16, counted=counted)
    with pytest.raises(ValueError, match="window must be >= 2"):
        cut_windows(data, 1)
    with pytest.raises(ValueError, match=r"pad_before must be in 0\.\.15"):
        make_window_buffer(data, 16, 4, pad_before=16)
    with pytest.raises(KeyError, match='"states"'):
        make_window_buffer(data, 16, 4, select=["observation", "states"])
    with pytest.raises(KeyError, match='"episode"'):
        make_window_buffer(data.exclude("episode"), 16, 4)
    for cut in (cut_windows, lambda data, window: make_window_buffer(data, window, 4)):
        with pytest.raises(ValueError, match=r"flat data .* got batch size \[2, 20\] and 'episode' \[2, 20\]"):
            cut(demonstrations((20, 20)).reshape(2, 20), 16)
        with pytest.raises(ValueError, match=r"got batch size \[\d+\] and 'episode' \[\d+, 1\]"):
            cut(data.copy().set("episode", data["episode"].unsqueeze(-1)), 16)
    with pytest.raises(ValueError, match="of a batch of 4 rounds to 0 windows"):
        make_window_buffer(data, 16, 4, labelled_share=0.1)


def test_short_trajectories_are_named():
    data = demonstrations((20, 15, 16, 3))
    with pytest.raises(ValueError, match=r"2 of 4 trajectories .*\(16 steps\): 1 \(15 steps\), 3 \(3 steps\)"):
        make_window_buffer(data, 16, 4)
    make_window_buffer(demonstrations((15,)), 16, 1, pad_before=1)


@pytest.mark.parametrize("device", ["cpu", GPU])
def test_batches_are_on_the_device_of_the_data(device):
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
    assert spread_evenly(rows, 4).tolist() == [0, 3, 6, 9] and spread_evenly(rows[:9], 4).tolist() == [0, 3, 5, 8]
    assert spread_evenly(rows, 10) is rows and len(spread_evenly(rows[:0], 4)) == 0
    assert len(spread_evenly(rows[:1].expand(2**24 + 4), 4)) == 4  # float32 does not hold the last row's number


def make(share):
    data, _ = LabelBudget(count=1, seed=1).apply(demonstrations())
    return make_window_buffer(data, 16, 6, labelled_share=share)


def test_only_windows_with_a_label_on_one_frame_are_cut():
    data = demonstrations((20, 20))
    data["has_action"][:] = False
    data["has_action"][[0, 4, 23, 30]] = True
    cut = cut_windows(data, 6, pad_before=3, labelled_frame=3)
    assert cut["has_action"][:, 3].all()
    assert torch.equal(cut["step_count"][:, 3], data["step_count"][[0, 4, 23, 30]])
    few = cut_windows(data, 6, pad_before=3, labelled_frame=3, most=2)
    assert torch.equal(few["step_count"], cut["step_count"][[0, 3]])


def test_windows_are_equally_likely():
    torch.manual_seed(0)
    data = demonstrations((16, 116))
    buffer = make_window_buffer(data, 16, 20_400, select=["observation"])
    counts = torch.zeros(102)
    for trajectory, steps in seen(buffer.sample()):
        counts[0 if trajectory == 0 else 1 + steps[0]] += 1
    # 102 windows, 200 expected each: chi-squared with 101 degrees of freedom is below 150 in 99.9 %
    assert ((counts - 200) ** 2 / 200).sum() < 150


@pytest.mark.parametrize(
    ("share", "size", "number"), [(0.25, 16, 4), (0.5, 5, 3), (0.1, 7, 1), (1.0, 8, 8), (0.9, 4, 4)]
)
def test_every_batch_holds_its_share(share, size, number):
    data, _ = LabelBudget(count=1, seed=2).apply(demonstrations())  # the longest: 25 windows of 49
    buffer = make_window_buffer(data, 16, size, labelled_share=share)
    for _ in range(12):
        batch = buffer.sample()
        inner = batch["has_action"][:, 1:15].any(1).squeeze(-1)
        assert inner.tolist() == [True] * number + [False] * (size - number)


def test_fully_labelled_data_have_no_other_windows():
    sampler = WindowSampler(torch.ones(7, dtype=torch.bool), labelled_share=0.25)
    torch.manual_seed(0)
    assert set(sampler.sample(None, 400)[0][100:].tolist()) == set(range(7))


def test_wrong_shares():
    nothing = torch.zeros(49, dtype=torch.bool)
    with pytest.raises(ValueError, match="none of the 49 windows has a label"):
        WindowSampler(nothing, labelled_share=0.25)
    for wrong in (0, -0.1, 1.1):
        with pytest.raises(ValueError, match="labelled_share must be in"):
            WindowSampler(~nothing, labelled_share=wrong)


@pytest.mark.parametrize("share", [None, 0.5])
def test_a_run_goes_on_where_it_stopped(share):
    """The random state is all of it: the sampler has none of its own."""
    buffer, resumed = make(share), make(share)
    buffer.sample()
    state = torch.get_rng_state()
    expected = [seen(buffer.sample()) for _ in range(9)]
    resumed.sample()
    torch.set_rng_state(state)
    assert [seen(resumed.sample()) for _ in range(9)] == expected


@pytest.mark.parametrize("own", [True, False])
def test_sampling_uses_an_own_generator_or_the_global_one(own):
    draws = []
    for number in range(2):
        torch.manual_seed(number if own else 0)
        buffer = make(0.5)
        if own:
            buffer.set_rng(torch.Generator().manual_seed(0))
        draws.append([seen(buffer.sample()) for _ in range(2)])
    assert draws[0] == draws[1] and draws[0][0] != draws[0][1]
