# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests animations and films: contents, number of frames, start, and files."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from run_files import make_object_rollouts, make_rollouts, run_of
from toy_gym import Drawn

from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.reports import animation
from torchrl_koap.reports.animation import animate_rollouts
from torchrl_koap.reports.pictures import Film, NotFilmed, NothingToDraw, save_film
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import get_task

RUN = run_of("avoiding")


def test_animation_shows_every_step_and_holds_the_end(tmp_path):
    path = tmp_path / "a.gif"
    film = animate_rollouts(make_rollouts(), RUN)
    frames = list(film.frames)
    save_film(Film(frames, film.seconds), path)
    dark = np.diff([(frame < 60).all(-1).sum() for frame in frames])
    assert dark.argmax() == 9  # the square of what ran out of time
    with Image.open(path) as film:
        assert film.n_frames == 11 and film.info["duration"] == 70  # steps 0, 2, ..., 18, 19; 2 x 35 ms
        first = np.asarray(film.convert("L")).astype(int)
        film.seek(10)
        assert film.info["duration"] == 1500
        assert (np.abs(np.asarray(film.convert("L")).astype(int) - first) > 60).sum() > 500
    assert path.stat().st_size < 2e6


def test_the_line_ahead_of_a_dot_is_the_latest_plan_without_its_executed_part():
    plan, made = np.arange(24.0).reshape(3, 4, 2), np.array([0, 4, -1])
    for step, line in ((0, plan[0]), (3, plan[0, 3:]), (4, plan[1]), (6, plan[1, 2:])):
        np.testing.assert_array_equal(animation._latest_plan(plan, made, step), line)


def test_objects_move_in_the_animation():
    """A box that nothing else covers is drawn where it is: red pixels at its last place, none at its first."""
    run = run_of("stacking")
    first, *_, last = animate_rollouts(make_object_rollouts("stacking", episodes=1), run).frames
    red = [(frame[..., 0] > 180) & (frame[..., 1:] < 70).all(-1) for frame in (first.astype(int), last.astype(int))]
    assert red[0].sum() > 10 and red[1].sum() > 10 and not (red[0] & red[1]).any()
    assert np.argwhere(red[0])[:, 0].mean() > np.argwhere(red[1])[:, 0].mean() + 50  # it moves away, up in the picture


def test_long_animations_skip_steps():
    long = {"position": np.random.rand(1, 1000, 2), "length": [1000], "mode": [0], "outcome": [1]}
    long |= {"plan": np.zeros((1, 0, 14, 2)), "plan_step": np.zeros((1, 0), int)}
    film = animate_rollouts(long, RUN)
    assert film.seconds == pytest.approx(6 * 0.035) and len(list(film.frames)) <= 171


def test_no_rollouts():
    none = {"position": np.zeros((0, 5, 2)), "length": [], "mode": [], "outcome": []}
    with pytest.raises(NothingToDraw, match="no rollouts"):
        animate_rollouts(none, RUN)


def film_of(rollouts, task):
    return animation.film_rollout(rollouts, run_of(task))


def frames_of(actions, task, monkeypatch, size, **more):
    monkeypatch.setattr(animation, "SIZE", size)
    try:
        return film_of({"action": actions[None], "outcome": [1], **more}, task).frames
    except NotFilmed as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")


def test_film_of_recorded_actions(monkeypatch):
    actions = np.full((7, 2), 0.008)
    actions[6] = np.nan
    frames = frames_of(actions, "avoiding", monkeypatch, (96, 72))
    assert len(frames) == 4 and frames[0].shape == (72, 96, 3)  # the start, and after 2, 4, 6 steps


@pytest.mark.parametrize("task", ["aligning", "po_sorting"])
def test_film_starts_from_the_context(task, monkeypatch):
    table, actions = evaluation_contexts(task), np.zeros((1, get_task(task).action_dim))
    first, again, other = (
        frames_of(actions, task, monkeypatch, (96, 72), context=table[row, None])[0].astype(int) for row in (0, 0, 1)
    )
    assert (first == again).all() and (np.abs(first - other) > 50).any()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({}, "missing entry 'context'"),
        ({"context": np.zeros((1, 2, 3))}, r"'context' must have shape \[any, 4, 3\]"),
        ({"action": np.zeros((1, 3, 5))}, r"'action' must have shape \[any, any, 2\]"),
    ],
)
def test_bad_rollouts_are_explained(more, message):
    with pytest.raises(ValueError, match=message):
        film_of({"action": np.zeros((1, 3, 2)), "outcome": [1]} | more, "sorting")


def test_the_first_success_is_filmed(monkeypatch):
    made = []
    monkeypatch.setattr(animation, "_film_frames", lambda *what: made.append(what) or [])
    rollouts = make_object_rollouts("stacking_1") | {"outcome": np.array([0, 0, 1, 1])}
    film_of(rollouts, "stacking_1")
    ((actions, of, context, stride),) = made
    np.testing.assert_array_equal(actions, rollouts["action"][2])
    assert of.name == "stacking_1" and stride == 2
    np.testing.assert_array_equal(context, rollouts["context"][2:3])
    assert context.dtype == np.float64
    film = film_of({"action": np.zeros((1, 60, 2)), "outcome": [1]}, "avoiding")
    assert made[1][3] == 3 and film.seconds == pytest.approx(0.07)  # a long rollout has few frames, and is fast


def test_a_rollout_in_gymnasium_is_played_again_from_its_seed():
    rows = [{"seed": 5}, {"seed": 6}]
    evaluation = {"env": "toy_gym:ToyDrawn-v0", "env_kwargs": ["shade=7"], "episode": rows}
    rollouts = {"outcome": np.array([0, 1]), "action": np.full((2, 5, 2), 0.1, np.float32)}
    film = animation.film_rollout(rollouts, RunFacts(Path("run"), None, evaluation=evaluation))
    env = Drawn(shade=7, render_mode="rgb_array")
    env.reset(seed=6)  # the first success
    first = env.render()
    for _ in range(5):
        env.step(np.full(2, 0.1, np.float32))
    frames = list(film.frames)
    assert len(frames) == 4
    np.testing.assert_array_equal(frames[0], first)
    np.testing.assert_array_equal(frames[-1], env.render())


def test_an_environment_that_cannot_be_drawn_is_told():
    evaluation = {"env": "toy_gym:ToyReach-v0", "episode": [{"seed": 5}]}
    rollouts = {"outcome": np.array([0]), "action": np.zeros((1, 5, 2), np.float32)}
    with pytest.raises(NotFilmed, match=r"environment 'toy_gym:ToyReach-v0' was not filmed: \w+\("):
        animation.film_rollout(rollouts, RunFacts(Path("run"), None, evaluation=evaluation))
