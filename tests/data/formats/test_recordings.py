# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests arrays as recordings: which rows are labels, and one clear message per fault."""

import numpy as np
import pytest
import torch

from torchrl_koap.data.formats.recordings import make_recordings
from torchrl_koap.files import DataError

FRAMES = np.arange(15.0).reshape(5, 3)


def test_one_action_per_frame_or_per_transition():
    steps = np.arange(10.0).reshape(5, 2)
    recordings = make_recordings([FRAMES, FRAMES], [steps, steps[:4]])
    assert all(np.array_equal(kept, steps[:4]) for kept in recordings.actions)
    assert recordings.state_names == ("state_0", "state_1", "state_2")


def test_what_has_no_label():
    steps = np.ones((4, 2))
    steps[1, 0] = np.nan  # half an action is none
    last = np.append(np.ones((4, 2)), [[1, np.nan]], axis=0)  # leads to no frame
    recordings = make_recordings([FRAMES] * 4, [None, steps, np.full((5, 2), np.nan), last])
    assert recordings.num_labels == 7
    assert recordings.skipped == ("actions of which only some columns are known (1 in trajectory 1)",)
    assert np.isnan(recordings.actions[1][1]).all() and np.isnan(recordings.actions[0]).all()
    assert recordings.actions[0].shape == (4, 2)


@pytest.mark.parametrize("empty", [[], np.zeros((0, 2)), torch.zeros(0)])
def test_empty_actions_are_none(empty):
    recordings = make_recordings([FRAMES, FRAMES], [np.ones((4, 2)), empty])
    assert recordings.num_labels == 4 and np.isnan(recordings.actions[1]).all()


def test_no_labels_at_all_needs_their_width():
    for number in (7, np.int64(7)):
        assert make_recordings([FRAMES], action_dim=number).actions[0].shape == (4, 7)
    assert make_recordings([FRAMES], action_names=["a", "b"]).actions[0].shape == (4, 2)
    with pytest.raises(DataError, match=r"number of action columns in action_dim .*, or the action columns of tables"):
        make_recordings([FRAMES])


def test_masked_and_none_entries_are_unknown():
    """A mask that is not looked at would make labels of what its owner has ruled out."""
    hidden = np.ma.masked_array(np.ones((4, 2)), mask=np.arange(4)[:, None] == [1, 1])
    objects = np.array([[1.0, None], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0]])
    for steps in (hidden, objects):
        recordings = make_recordings([FRAMES.astype(object)], [steps])
        assert recordings.num_labels == 3 and recordings.states[0].dtype == np.float64
    with pytest.raises(DataError, match="not finite, first at frame 1 in column 'state_0'"):
        make_recordings([np.ma.masked_equal(FRAMES, 3.0)], action_dim=1)


def test_arrays_of_any_type_of_numbers():
    kept = [FRAMES.astype(kind) for kind in ("f2", ">f4", ">i8", "u1")] + [np.asfortranarray(FRAMES), FRAMES[::-1]]
    kept += [torch.from_numpy(FRAMES).bfloat16(), (torch.from_numpy(FRAMES) * 1j).conj().imag.neg()]
    kept += [torch.from_numpy(FRAMES).float().requires_grad_()]
    recordings = make_recordings((frames for frames in kept), [torch.ones(4, 1)] * 9)
    assert [frames.sum() for frames in recordings.states] == [105.0] * 9 and recordings.num_labels == 36
    assert {frames.dtype for frames in recordings.states} == {np.dtype(np.float64)}


def with_nan(array):
    array = array.copy()
    array[2, 1] = np.nan
    return array


@pytest.mark.parametrize(
    ("states", "actions", "options", "message"),
    [
        ([], None, {}, "there are no trajectories"),
        ([FRAMES], [None, None], {}, "1 trajectories of states, 2 of actions"),
        ([FRAMES, FRAMES[:, :2]], None, {"action_dim": 1}, "trajectory 1: states have 2 columns, those before have 3"),
        ([FRAMES[:1]], [None], {"action_dim": 1}, "trajectory 0: 1 frames; a transition needs two"),
        ([FRAMES.astype(complex)], [np.ones((4, 1))], {}, "trajectory 0: states are complex128, wanted numbers"),
        ([FRAMES[0]], [np.ones((4, 1))], {}, r"trajectory 0: states must be \[T, d\], got \[3\]"),
        ([with_nan(FRAMES)], [np.ones((4, 1))], {}, "not finite, first at frame 2 in column 'state_1'"),
        ([FRAMES], [np.full((4, 1), np.inf)], {}, "the action of step 0 is infinite; mark unknown actions by NaN"),
        ([FRAMES], [np.ones((6, 1))], {}, "6 actions for 5 frames; wanted one per frame"),
        ([FRAMES], [np.ones((3, 1))], {}, r"3 actions for 5 frames; wanted one per frame \(5\) or one per"),
        ([FRAMES], [np.ones(4)], {}, r"actions must be \[T, a\] or \[T - 1, a\], got \[4\]"),
        (
            [FRAMES],
            [np.array([["x"]] * 4)],
            {},
            "used: trajectory 0: actions are <U1, wanted numbers in the unit that .*reports$",
        ),
        ([FRAMES], None, {}, "no trajectory has actions: give the number of action columns in action_dim"),
        ([FRAMES, FRAMES], [np.ones((4, 1)), np.ones((4, 2))], {}, "trajectory 1: actions have 2 columns"),
        ([FRAMES], [np.ones((4, 1))], {"action_dim": 3}, r"actions have 1 columns, action_dim \(--action-dim\) says 3"),
        ([FRAMES], [np.ones((4, 1))], {"state_names": ["a", "b"]}, "state_names has 2 names for 3 columns"),
        ([FRAMES], [np.ones((4, 1))], {"state_names": ["a", "b", "a"]}, "state_names holds a more than once"),
        ([FRAMES], [np.ones((4, 1))], {"state_names": "abc"}, "state_names must be a list of 3 names, got"),
        ([FRAMES], None, {"action_dim": -1}, r"action_dim \(--action-dim\) must be a positive whole number, got -1"),
        ([FRAMES], None, {"action_dim": "2"}, "must be a positive whole number, got '2'"),
        ([FRAMES], [np.ones((4, 1))], {"control_hz": 0}, r"control_hz \(--control-hz\) must be a positive"),
        ([FRAMES], [np.ones((4, 1))], {"control_hz": True}, "must be a positive number .* got True"),
        ([torch.ones(5, 3).to_sparse()], None, {"action_dim": 1}, r"are no table of numbers \[T, d\], got Tensor"),
        ([{"q": FRAMES}], None, {"action_dim": 1}, r"states are no table of numbers \[T, d\], got dict"),
        ({"q": [FRAMES]}, None, {"action_dim": 1}, "got dict: give the arrays of its entries as lists, in the arg"),
        ("recordings", None, {"action_dim": 1}, r"sequence of arrays \[T, d\], .* got str: files are read by read_rec"),
        (FRAMES, [FRAMES], {}, r"states must be a list of recordings \[T, d\], got one array \[5, 3\]"),
        ([FRAMES], torch.ones(4, 2), {}, r"actions must be a list of .*\[T - 1, a\], got one array \[4, 2\]"),
        (3.0, None, {"action_dim": 1}, "got float"),
        ([FRAMES, FRAMES], [np.ones((9, 1))] * 2, {}, "used: trajectory 0, trajectory 1: 9 actions for 5 frames"),
    ],
)
def test_faults_are_named(states, actions, options, message):
    with pytest.raises(DataError, match=message):
        make_recordings(states, actions, **options)


def test_lists_of_different_lengths_and_truth_values():
    with pytest.raises(DataError, match="trajectory 1: states are lists of different lengths: rows of 1 and 2 numbers"):
        make_recordings([[[1.0, 2.0], [2.0, 2.0]], [[1.0, 2.0], [2.0]]], action_dim=1)
    assert make_recordings([[[True], [False]]], action_dim=1).states[0].tolist() == [[1.0], [0.0]]


def test_all_faults_are_told_at_once():
    with pytest.raises(DataError) as caught:
        make_recordings([FRAMES[:1], FRAMES.astype(complex)], [None, np.ones((9, 1))], sources=["left", "right"])
    assert len(caught.value.problems) == 2 and "trajectory left" in str(caught.value)


class Frame:
    """What is read of a data frame of pandas."""

    shape = (2, 2)

    def __init__(self, columns, values):
        self.columns, self.values = list(columns), np.asarray(values, dtype=float)

    def __getitem__(self, names):
        return Frame(names, self.values[:, [self.columns.index(name) for name in names]])

    def __array__(self, dtype=None, copy=None):
        return self.values


def test_columns_of_data_frames_are_matched_by_name():
    first, second = Frame("ab", [[1, 2], [3, 4]]), Frame("ba", [[2, 1], [4, 3]])
    recordings = make_recordings([first, second], [Frame(["u"], [[7]]), None])
    assert (recordings.state_names, recordings.action_names) == (("a", "b"), ("u",))
    assert np.array_equal(recordings.states[0], recordings.states[1])
    turned = make_recordings([first, second], action_dim=1, state_names=["b", "a"])
    assert turned.state_names == ("b", "a") and turned.states[0].tolist() == [[2, 1], [4, 3]]
    assert make_recordings([first], action_dim=1, state_names=["x", "y"]).state_names == ("x", "y")
    with pytest.raises(DataError, match="trajectory 1: columns of states differ from those before by b, c"):
        make_recordings([first, Frame("ac", [[1, 2], [3, 4]])], action_dim=1)
    with pytest.raises(DataError, match=r"states must be a list of recordings \[T, d\]"):
        make_recordings(first, action_dim=1)
