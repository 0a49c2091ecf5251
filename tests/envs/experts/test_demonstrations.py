# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests recorded demonstrations: modes, rows, repeatability, resuming after an interruption."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from command_calls import contents

from torchrl_koap.data.ted import load_ted, read_about
from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.envs.avoiding import AvoidingEnv
from torchrl_koap.envs.experts import demonstrations
from torchrl_koap.envs.experts.avoiding import AvoidingExpert
from torchrl_koap.envs.experts.demonstrations import (
    RecordingError,
    balanced_modes,
    iterate_takes,
    record_demonstrations,
    record_to_folder,
)
from torchrl_koap.envs.experts.recording import Attempt, ar1_noise
from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.evaluation.closed_loop import choose_contexts
from torchrl_koap.keys import validate
from torchrl_koap.tasks import TASKS, Body, get_task
from torchrl_koap.tasks.avoiding import FINISH_Y, OBSTACLES, ROD_RADIUS
from torchrl_koap.tasks.modes import Modes

EPISODES = 26


@pytest.fixture(scope="module")
def recording():
    calls = []
    data, report = record_demonstrations(
        "avoiding", EPISODES, seed=5, progress=lambda done, total: calls.append((done, total))
    )
    return data, report, calls


def test_report(recording):
    data, report, calls = recording
    assert len(report.each("rows")) == len(report.each("attempts")) == EPISODES
    assert trajectory_lengths(validate(data)).tolist() == [rows - 1 for rows in report.each("rows")]
    assert np.bincount(report.each("mode"), minlength=24).min() == 1 and len(set(report.each("mode")[24:])) == 2
    assert sum(report.each("attempts")) - EPISODES == sum(report.notes["discarded_attempts"].values())
    assert f"{EPISODES} demonstrations of avoiding in 24 modes (" in str(report)
    assert " modes" not in str(replace(report, task=replace(report.task, modes=Modes())))
    done = [call[0] for call in calls]
    assert done == sorted(done) and calls[-1] == (EPISODES, EPISODES)


def test_recorded_rows_are_those_of_the_original_recorder(recording):
    data = recording[0]
    for take in iterate_takes("avoiding", EPISODES, seed=5, done=range(2, EPISODES)):
        assert len(take.frames) == len(take.actions) + 1 == take.log["rows"]
        assert np.allclose(take.frames[0, 2:], (0.524928, -0.279737), atol=1e-5)
        recorded = data["observation"][data["episode"] == take.number]
        np.testing.assert_array_equal(take.frames[:-1].astype(np.float32), recorded)


def test_demonstrations_are_successes_with_clearance(recording):
    data = recording[0]
    for number in range(EPISODES):
        path = data["next", "observation"][data["episode"] == number][:, 2:].numpy()
        assert path[-1, 1] > FINISH_Y
        for _, x, y, radius, _ in OBSTACLES:
            assert np.linalg.norm(path - (x, y), axis=1).min() > radius + ROD_RADIUS + 0.003


def test_replayed_actions_give_the_same_episode(recording):
    """Recorded actions, sent to a fresh environment, reproduce the rows, outcome and mode."""
    report = recording[1]
    for take in iterate_takes("avoiding", EPISODES, seed=5, done={*range(EPISODES)} - {0, 13, 25}):
        frames, actions = take.frames, torch.from_numpy(take.actions)
        env = AvoidingEnv(1, dtype=torch.float64)
        step = env.reset()
        # the command of row 0 is a step from the start
        first = torch.from_numpy(frames[:1, :2]) - step["observation"][:, :2]
        for row, action in enumerate(torch.cat([first, actions])):
            step = env.step(step.set("action", action[None]))["next"]
            assert np.allclose(env.raw_log()[0]["c_pos"][0, :2], frames[row, 2:], atol=1e-9, rtol=0)
            seen = step["observation"][0].numpy()
            assert np.allclose(seen[:2], frames[row, :2], atol=1e-12, rtol=0)
            # the environment hands out the position of 1 ms before the recorder's
            assert np.allclose(seen[2:], frames[row, 2:], atol=1e-3, rtol=0)
        assert step["success"].item() and not step["collision"].item()
        assert env.task.modes.index_of(step["mode"]).item() == report.each("mode")[take.number]


def test_an_environment_that_draws_its_own_starts_is_seeded(monkeypatch):
    seeds = []
    monkeypatch.setattr(AvoidingEnv, "_set_seed", lambda env, seed: seeds.append(seed))
    for seed in (0, 0, 1):
        record_demonstrations("avoiding", 1, seed)
    same, other = [value for value in seeds if value is not None][:2], seeds[-1]
    assert same[0] == same[1] != other


def test_bodies_that_start_alike_in_every_episode_have_no_contexts(monkeypatch):
    task = get_task("avoiding")
    drawn = replace(task, name="drawn", scene=replace(task.scene, bodies=(Body("rod", "measured_xy"),)))
    monkeypatch.setitem(TASKS, "drawn", drawn)
    data, _ = record_demonstrations("drawn", 1, 0)
    assert len(data) > 50
    assert choose_contexts(drawn, EvalConfig()) == (None, None)


def test_modes_are_balanced():
    assert np.bincount(balanced_modes(96, 24, 0)).tolist() == [4] * 24
    counts = np.bincount(balanced_modes(29, 24, 1), minlength=24)
    assert counts.sum() == 29 and set(counts) == {1, 2}
    further = balanced_modes(29, 24, 1)[24:]
    assert further == sorted(further)
    assert balanced_modes(5, 24, 1) != balanced_modes(5, 24, 2)


def test_failed_attempts_are_counted_and_given_up_on(monkeypatch):
    into_the_first_cylinder = np.array([-0.0006, 0.012])
    monkeypatch.setattr(AvoidingExpert, "act", lambda self, seen: np.tile(into_the_first_cylinder, (len(seen), 1)))
    monkeypatch.setattr(demonstrations, "MAX_ATTEMPTS", 2)
    with pytest.raises(RecordingError, match=r"episodes \[0, 1\].*'collision': 4"):
        record_demonstrations(episodes=2)


def test_attempts_have_other_draws_and_after_four_another_context(monkeypatch):
    contexts, seeds = [], []

    def fail(env, task, modes, drawn, own, progress, hand):
        contexts.append(drawn.copy())
        seeds.extend(own)
        return [Attempt(np.zeros((2, 20)), np.zeros((1, 3)), 2, "mode")]

    monkeypatch.setattr(demonstrations, "play", fail)
    monkeypatch.setattr(demonstrations, "MAX_ATTEMPTS", 6)
    with pytest.raises(RecordingError, match="'mode': 6"):
        record_demonstrations("aligning", 1)
    same = [np.array_equal(contexts[0], each) for each in contexts]
    assert same == [True] * 4 + [False] * 2 and np.array_equal(contexts[4], contexts[5])
    assert seeds == [(0, 0, attempt) for attempt in range(6)]


@pytest.mark.parametrize(("limit", "value", "reason"), [("least_clearance", 1.0, "close"), ("most_rows", 30, "slow")])
def test_attempts_unlike_human_ones_are_discarded(monkeypatch, limit, value, reason):
    monkeypatch.setattr(AvoidingExpert, limit, value)
    monkeypatch.setattr(demonstrations, "MAX_ATTEMPTS", 1)
    with pytest.raises(RecordingError, match=f"'{reason}': 1"):
        record_demonstrations(episodes=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes must be an integer of at least 1, got 0"),
        ({"episodes": 2.5}, "episodes must be an integer"),
        ({"seed": -1}, "seed must be an integer of at least 0"),
        ({"num_threads": 0}, "num_threads must be an integer of at least 1"),
        ({"batch_size": 0}, "batch_size must be an integer of at least 1, got 0"),
        ({"task": "scooping"}, "demonstrations of task 'scooping' are videos: use record_videos"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        record_demonstrations(**arguments)


TASK = get_task("avoiding")
COUNT = 3


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "demos"
    return folder, record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1)


def test_a_recording_in_memory_has_the_same_data_whatever_threads_progress_and_batch(whole):
    (folder, report), calls = whole, []
    torch.manual_seed(0)
    state = torch.random.get_rng_state()
    data, again = record_demonstrations(
        "avoiding", COUNT, seed=3, num_threads=2, batch_size=2, progress=lambda done, total: calls.append(done)
    )
    assert (load_ted(folder / "ted")[0] == data).all() and data["action"].dtype == torch.float32
    assert all(report.each(name) == again.each(name) for name in ("mode", "rows", "attempts"))
    assert calls == sorted(calls) and calls[-1] == COUNT and 1 in calls
    assert torch.equal(torch.random.get_rng_state(), state)
    assert [path.name for path in folder.iterdir()] == ["ted"]
    notes = read_about(folder / "ted")["notes"]
    assert notes["seed"] == 3 and notes["modes"] == report.each("mode") and notes["attempts"] == report.each("attempts")


class Stop(Exception):
    pass


def interrupt_after(monkeypatch, number):
    """Ends a recording, as a signal would, once ``number`` demonstrations are there; returns those asked for."""
    iterate = demonstrations.iterate_takes
    asked = []

    def some(*arguments, done=(), **options):
        asked.append(sorted(done))
        for count, take in enumerate(iterate(*arguments, done=done, **options)):
            if count == number:
                raise Stop
            yield take

    monkeypatch.setattr(demonstrations, "iterate_takes", some)
    return asked


def test_an_interrupted_recording_goes_on(whole, tmp_path, monkeypatch):
    folder = tmp_path / "demos"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.raises(Stop):
            record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1, batch_size=3)
    # files are there before the recording is over
    assert len(list((folder / "unfinished").glob("*.npz"))) == 2 and not (folder / "ted").exists()
    asked, calls = interrupt_after(monkeypatch, 99), []
    record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1, progress=lambda done, total: calls.append(done))
    assert asked[-1] == [0, 1] and calls[0] == 2 and calls[-1] == COUNT and calls == sorted(calls)
    assert contents(folder) == contents(whole[0])


def test_other_demonstrations_are_left_alone(whole, tmp_path, monkeypatch):
    before = contents(whole[0])
    with pytest.raises(FileExistsError, match="holds a data set, recordings or a run already; choose another --out"):
        record_to_folder(whole[0], TASK, COUNT, seed=3)
    assert contents(whole[0]) == before
    interrupt_after(monkeypatch, 1)
    with pytest.raises(Stop):
        record_to_folder(tmp_path, TASK, COUNT, seed=3, num_threads=1, batch_size=1)
    with pytest.raises(FileExistsError, match="interrupted recording with seed 3, not 4, disturbance 0.0, not 0.5"):
        record_to_folder(tmp_path, TASK, COUNT, seed=4, disturbance=0.5)
    assert json.loads((tmp_path / "unfinished" / "request.json").read_text())["seed"] == 3


def test_a_drifting_hand_deviates_as_much_at_every_step():
    noise = ar1_noise(np.random.default_rng(0), 10.0, 0.5, (40, 20_000))
    assert np.abs(noise.std(1) - 0.5).max() < 0.02
    assert np.mean(noise[1:] * noise[:-1]) == pytest.approx(0.25 * np.exp(-1 / 10), abs=0.01)
