# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests time alignment: frames read, valid frames, and the scales of steps."""

import pytest
import torch

from torchrl_koap.modules import LatentActionMLP, WindowReader

CASES = [(1, 8), (0, 2), (4, (2, 3, 4, 6, 8)), (2, (5, 3)), (1, 7)]


def reader_of(num_past, look_ahead, **options):
    return WindowReader(1, num_past=num_past, look_ahead=look_ahead, **options)


def offsets(num_past, look_ahead):
    ahead = [look_ahead] if isinstance(look_ahead, int) else sorted(look_ahead)
    return [*range(-num_past, 1), *ahead]


# the table


@pytest.mark.parametrize("num_frames", [11, 14, 16])
@pytest.mark.parametrize(("num_past", "look_ahead"), CASES)
def test_clamping_and_spans_by_brute_force(num_past, look_ahead, num_frames):
    rows = reader_of(num_past, look_ahead).index(num_frames).tolist()
    wanted = offsets(num_past, look_ahead)
    unclamped, clamped = [], []
    for t, row in enumerate(rows):
        assert row == [min(max(t + offset, 0), num_frames - 1) for offset in wanted]
        whole = all(0 <= t + offset < num_frames for offset in wanted)
        ahead = row[num_past + 1 :]
        if whole:
            unclamped.append(t)
        if t - num_past >= 0 and t + 1 < num_frames and all(frame > t + 1 for frame in ahead):
            clamped.append(t)
    if unclamped:
        assert list(reader_of(num_past, look_ahead).valid_frames(num_frames)) == unclamped
    assert list(reader_of(num_past, look_ahead, clamped=True).valid_frames(num_frames)) == clamped
    part = range(2, 6)
    assert reader_of(num_past, look_ahead).index(num_frames, part).tolist() == rows[2:6]


@pytest.mark.parametrize("clamped", [False, True])
@pytest.mark.parametrize(("num_past", "look_ahead"), CASES)
def test_the_shortest_window_holds_one_frame_and_one_less_is_an_error(num_past, look_ahead, clamped):
    needed = num_past + 1 + (2 if clamped else max(offsets(num_past, look_ahead)))
    assert reader_of(num_past, look_ahead, clamped=clamped).valid_frames(needed) == range(num_past, num_past + 1)
    for number in (needed - 1, 1, 0):
        with pytest.raises(ValueError, match=f"a window of {number} frames is too short .* at least {needed} frames"):
            reader_of(num_past, look_ahead, clamped=clamped).valid_frames(number)


@pytest.mark.parametrize("look_ahead", [1, 0, -3, (8, 1), ()])
def test_offsets_that_would_read_the_action_raise_errors(look_ahead):
    with pytest.raises(ValueError, match=r"x_\(t\+1\) is never an input"):
        reader_of(1, look_ahead)


def test_num_past_must_not_be_negative():
    with pytest.raises(ValueError, match="num_past must be >= 0 frames, got -1"):
        LatentActionMLP(2, 2, num_past=-1)
    assert reader_of(0, [8, 2, 4]).look_ahead == (2, 4, 8)


# steps and their scales


def test_scales_make_every_step_of_unit_spread():
    state = torch.randn(50, 12, 3, generator=torch.Generator().manual_seed(1)).cumsum(1) * torch.tensor(
        [1.0, 1e-3, 5.0]
    )
    reader = WindowReader(3, num_past=2, look_ahead=(1, 4), min_offset=1)
    frames = reader.valid_frames(12)
    plain = reader.gather(state, frames)
    for t in frames:
        x = {offset: state[:, t + offset] for offset in (-2, -1, 0, 1, 4)}
        expected = torch.stack([x[-1] - x[-2], x[0] - x[-1], x[0], x[1] - x[0], x[4] - x[1]], 1)
        torch.testing.assert_close(plain[:, t - frames.start], expected)
    reader.fit(state)
    reader.fit(state.reshape(10, 5, 12, 3))  # again, with other batch dimensions: the same
    read = reader(state, frames).unflatten(-1, (5, 3))
    steps = [0, 1, 3, 4]
    torch.testing.assert_close(read[..., steps, :].square().mean((0, 1)).sqrt(), torch.ones(4, 3))
    torch.testing.assert_close(reader.scales[steps], plain.square().mean((0, 1)).sqrt()[steps])
    assert torch.equal(read[..., 2, :], state[:, 2:8]) and "scales" in reader.state_dict()


def test_a_column_that_never_moves_is_left_alone():
    reader = WindowReader(1, look_ahead=(1, 2, 3, 4, 5), min_offset=1)
    reader.fit(torch.zeros(4, 12, 1))
    assert torch.equal(reader.scales, torch.ones(10, 1))


def test_a_given_spread_is_not_changed():
    reader, spread = WindowReader(1, num_past=1, look_ahead=(2,)), torch.tensor([[2.0], [3.0], [0.0]])
    reader.set_spread(spread)
    assert reader.scales.tolist() == [[2.0], [1.0], [1.0]] and spread.tolist() == [[2.0], [3.0], [0.0]]


def test_wrong_windows_and_offsets_are_named():
    reader = WindowReader(2, num_past=4, look_ahead=(1, 5), min_offset=1)
    with pytest.raises(ValueError, match="2 columns"):
        reader(torch.zeros(10, 3))
    with pytest.raises(ValueError, match="must be >= 1, got"):
        WindowReader(2, look_ahead=0, min_offset=1)
