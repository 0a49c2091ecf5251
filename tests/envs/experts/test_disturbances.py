# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests disturbances of scripted experts: effects on actions, share of episodes, notes in the recording."""

import numpy as np
import pytest

from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.envs.experts import demonstrations
from torchrl_koap.envs.experts.demonstrations import iterate_takes, record_demonstrations
from torchrl_koap.envs.experts.disturbances import (
    KINDS,
    Disturbances,
    choose_disturbed,
    disturbed_columns,
    height_column,
)
from torchrl_koap.envs.experts.recording import Attempt
from torchrl_koap.tasks import get_task

WANTED = np.array([[0.003, 0.01]])


def test_actions_change_within_the_spells_alone_and_as_their_names_say():
    hand = Disturbances(get_task("avoiding"), [(1, 0, 0)], [True])
    done = np.stack([hand.disturb(WANTED)[0] for _ in range(600)])
    inside, pace = np.zeros(len(done), dtype=bool), np.linalg.norm(WANTED)
    for begin, end, kind in hand.spells[0]:
        inside[begin:end] = kind != "late_turn"  # to go on as before changes nothing of a constant action
        for action in done[begin:end]:
            if kind == "slip":  # as quick as wanted, to the side
                assert np.isclose(np.linalg.norm(action), pace)
                assert 0.6 <= np.arccos(action @ WANTED[0] / pace**2) <= 1.4
            if kind == "impulse":
                assert 0.69 * pace <= np.linalg.norm(action - WANTED[0]) <= 1.41 * pace
    assert np.array_equal((np.abs(done - WANTED) > 1e-12).any(1), inside)
    assert {kind for _, _, kind in hand.spells[0]} == set(KINDS) - {"drift"}
    assert all(second[0] - first[1] >= 12 for first, second in zip(hand.spells[0], hand.spells[0][1:], strict=False))


def test_a_late_turn_holds_the_action_of_before():
    hand = Disturbances(get_task("avoiding"), [(1, 0, 0)], [True])
    wanted = np.stack([np.array([[0.001 * step, 0.01]]) for step in range(400)])
    done = np.stack([hand.disturb(action)[0] for action in wanted])
    late = [spell for spell in hand.spells[0] if spell[2] == "late_turn" and spell[1] <= 400]
    assert late
    for begin, end, _ in late:
        assert np.allclose(done[begin:end], wanted[begin - 1])


def test_episodes_are_disturbed_by_their_own_seed_alone():
    task = get_task("aligning")
    both = Disturbances(task, [(0, 3, 0), (0, 4, 0)], [True, True])
    one = Disturbances(task, [(0, 4, 0)], [True])
    wanted = np.random.default_rng(0).normal(0, 0.01, (200, 2, 3))
    for action in wanted:
        assert np.array_equal(both.disturb(action)[1], one.disturb(action[1:])[0])
    assert both.spells[1] == one.spells[0] != both.spells[0]
    few, many = choose_disturbed(50, 0.3, seed=7), choose_disturbed(500, 0.3, seed=7)
    assert np.array_equal(few, many[:50]) and 0.2 < many.mean() < 0.4
    assert not choose_disturbed(9, 0, seed=0).any() and choose_disturbed(9, 1, seed=0).all()


def test_the_height_of_a_tool_drifts_up_and_down_and_nothing_else_does_at_once():
    wanted = np.array([[0.006, 0.008, 0.0]])
    hand = Disturbances(get_task("aligning"), [(1, 0, 0)], [True])
    done = np.stack([hand.disturb(wanted)[0] for _ in range(900)])
    inside = np.zeros(len(done), dtype=bool)
    spells = [spell for spell in hand.spells[0] if spell[2] == "drift"]
    for begin, end, _ in spells:
        inside[begin:end] = True
        assert len(set(done[begin:end, 2])) == 1 and 4 <= end - begin <= 11
    height = done[:, 2]
    assert np.array_equal(height != 0, inside) and height.min() < 0 < height.max()
    assert (np.abs(height[inside]) >= 0.1 * 0.01).all() and (np.abs(height) <= 0.35 * 0.01).all()
    assert hand.spells[0] == sorted(hand.spells[0]) and {kind for _, _, kind in hand.spells[0]} == set(KINDS)
    flat = Disturbances(get_task("avoiding"), [(1, 0, 0)], [True])  # the same draws sideways
    assert np.array_equal(np.stack([flat.disturb(wanted[:, :2])[0] for _ in range(900)]), done[:, :2])


def test_grippers_are_left_alone():
    assert disturbed_columns(get_task("stacking")).tolist() == [*range(7)]
    assert [height_column(get_task(name)) for name in ("stacking", "sorting", "scooping")] == [None] * 3
    assert disturbed_columns(get_task("aligning")).tolist() == [0, 1]


def test_an_impulse_follows_the_steps_so_far_when_the_operator_rests():
    hand, pace = Disturbances(get_task("avoiding"), [(1, 0, 0)], [True]), np.linalg.norm(WANTED)
    done = [hand.disturb(WANTED * (step == 0))[0] for step in range(300)]
    impulses = [spell for spell in hand.spells[0] if spell[2] == "impulse" and spell[1] <= 300]
    assert impulses
    for begin, end, _ in impulses:
        for step in range(begin, end):
            assert 0.69 <= np.linalg.norm(done[step]) / (pace * 0.98**step) <= 1.41


def test_joints_slip_by_at_most_half_of_their_step():
    wanted = np.array([[0.01] * 7 + [0.08]])
    hand = Disturbances(get_task("stacking"), [(1, 0, 0)], [True])
    done = np.stack([hand.disturb(wanted)[0] for _ in range(400)])
    assert (done[:, 7] == 0.08).all()
    slips = [step for begin, end, kind in hand.spells[0] if kind == "slip" for step in range(begin, min(end, 400))]
    assert slips
    for off in np.abs(done[slips, :7] - 0.01):
        assert 0 < off.max() <= 0.5 * np.linalg.norm(wanted[0, :7])


def test_disturbances_are_noted_in_steps_of_the_data():
    spells = [(0, 3, "slip"), (4, 9, "impulse"), (6, 9, "slip")]
    of_d3il, other = (Attempt(np.zeros((6, 4)), np.zeros((5, 2)), steps) for steps in (6, 5))
    assert demonstrations._within(spells, of_d3il) == ((0, 2, "slip"), (3, 5, "impulse"))
    assert demonstrations._within(spells, other) == ((0, 3, "slip"), (4, 5, "impulse"))


@pytest.fixture(scope="module")
def disturbed():
    return record_demonstrations("avoiding", 6, seed=2, num_threads=1, disturbance=0.5)


def test_the_recording_says_how_often(disturbed):
    data, report = disturbed
    assert report.notes["disturbance"] == 0.5 and report.notes["spells"] == report.each("spells")
    attempts = sum(log["attempts"] for log in report.logs if log["disturbed"])
    recovered = sum(report.each("disturbed"))
    assert f"; {recovered} disturbed (" in str(report)
    assert f"recovered in {recovered} of {attempts} attempts" in str(report)
    assert recovered > 0 and sum(map(len, report.each("spells"))) > 0
    lengths = trajectory_lengths(data).tolist()
    for spells, chosen, length in zip(report.each("spells"), report.each("disturbed"), lengths, strict=True):
        assert chosen or not spells
        assert all(0 <= begin < end <= length for begin, end, _ in spells)


def test_undisturbed_episodes_are_those_of_a_recording_without(disturbed):
    data, report = disturbed
    plain, without = record_demonstrations("avoiding", 6, seed=2, num_threads=1)
    assert "disturbance" not in without.notes and "disturbed" not in str(without)
    for index, chosen in enumerate(report.each("disturbed")):
        same = np.array_equal(*(part["action"][part["episode"] == index] for part in (data, plain)))
        assert same == (not report.each("spells")[index]) or chosen


def test_recorded_actions_are_those_that_were_executed(disturbed, monkeypatch):
    """In a slip the recorded change of the command is not what the operator wanted."""
    done = []

    class Watched(Disturbances):
        def disturb(self, action):
            done.append(super().disturb(action)[0])
            return done[-1][None]

    monkeypatch.setattr(demonstrations, "Disturbances", Watched)
    (take,) = iterate_takes("avoiding", 1, seed=1, num_threads=1, disturbance=1.0)
    recorded = take.actions
    last = np.array(done[-len(recorded) - 1 :])[1:]  # the first action is the state that the log begins with
    assert take.log["attempts"] >= 1 and np.allclose(recorded, last, atol=1e-12)


def test_a_task_brings_its_share_of_disturbed_demonstrations():
    assert get_task("aligning").defaults.disturbance == 0.5 and get_task("avoiding").defaults.disturbance == 0
    assert demonstrations._share(get_task("aligning"), 0) == 0  # unless another one is asked for
    _, report = record_demonstrations("aligning", 1, seed=2, num_threads=1)
    assert report.notes["disturbance"] == 0.5 and report.each("disturbed") == list(choose_disturbed(1, 0.5, 2))


def test_an_operator_brings_the_tool_back_to_its_height():
    (take,) = iterate_takes("aligning", 1, seed=2, num_threads=1, disturbance=1.0)
    drifts, restored = [spell for spell in take.log["spells"] if spell[2] == "drift"], []
    command = take.frames[:, 2]
    for (begin, end, _), (later, _, _) in zip(drifts, [*drifts[1:], (len(command), 0, "")], strict=True):
        if begin > 60 and end + 15 < later:  # after the descent
            assert np.ptp(command[begin - 1 : end + 1]) > 0.004
            restored.append(abs(command[end + 15] - command[begin - 1]))
    assert restored and max(restored) < 0.004
