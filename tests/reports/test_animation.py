# This source code is licensed under the MIT license found in the LICENSE file.
"""Moving pictures: what is in them, how many, and that films start where the rollout did."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image
from run_files import make_object_rollouts, make_rollouts

from torchrl_koap.reports.animation import animate_rollouts, render_rollout
from torchrl_koap.tasks import get_task

ROLLOUTS = make_rollouts()


def test_animation_shows_every_step_and_holds_the_end(tmp_path):
    seen = []
    path = animate_rollouts(ROLLOUTS, tmp_path / "a.gif", stride=3, progress=lambda *done: seen.append(done))
    assert seen == [(number, 8) for number in range(1, 9)]  # steps 0, 3, ..., 18 and the last, 19
    with Image.open(path) as film:
        assert film.n_frames == 8 and film.info["duration"] == 100  # 3 x 35 ms, in hundredths of a second
        first = np.asarray(film.convert("L")).astype(int)
        film.seek(7)
        assert film.info["duration"] == 1500
        assert (np.abs(np.asarray(film.convert("L")).astype(int) - first) > 60).sum() > 500
    assert path.stat().st_size < 2e6


def test_objects_move_in_the_animation(tmp_path):
    """A box that nothing else covers is drawn where it is: red pixels at its last place, none at its first."""
    rollouts = make_object_rollouts("stacking", episodes=1)
    with Image.open(animate_rollouts(rollouts, tmp_path / "a.gif", task="stacking", stride=19)) as film:
        film.seek(film.n_frames - 1)
        last = np.asarray(film.convert("RGB")).astype(int)
        film.seek(0)
        first = np.asarray(film.convert("RGB")).astype(int)
    red = [(frame[..., 0] > 180) & (frame[..., 1:] < 70).all(-1) for frame in (first, last)]
    assert red[0].sum() > 10 and red[1].sum() > 10 and not (red[0] & red[1]).any()
    assert np.argwhere(red[0])[:, 0].mean() > np.argwhere(red[1])[:, 0].mean() + 50  # it moves away, up in the picture


def test_long_animations_skip_steps(tmp_path):
    steps = 1000
    long = {"position": torch.rand(1, steps, 2), "length": [steps], "mode": [0], "outcome": [1]}
    with Image.open(animate_rollouts(long, tmp_path / "a.gif", task="stacking")) as film:
        assert film.n_frames <= 171 and film.info["duration"] == 210  # 6 steps of 35 ms


@pytest.mark.parametrize(
    "call", [lambda path: animate_rollouts(ROLLOUTS, path), lambda path: render_rollout([[0, 0]], path)]
)
def test_animation_refuses_other_files(call, tmp_path):
    with pytest.raises(ValueError, match="written as .gif"):
        call(tmp_path / "a.avi")


@pytest.mark.parametrize(("option", "value"), [("episodes", [9]), ("episodes", []), ("stride", 0)])
def test_animation_options(option, value, tmp_path):
    with pytest.raises(ValueError, match=option):
        animate_rollouts(ROLLOUTS, tmp_path / "a.gif", **{option: value})


def film(*arguments, **options):
    try:
        return render_rollout(*arguments, **options)
    except RuntimeError as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")


def test_film_of_recorded_actions(tmp_path):
    pytest.importorskip("torchrl_koap.envs")
    actions = torch.full((6, 2), 0.008)
    actions[5] = torch.nan
    with Image.open(film(actions, tmp_path / "a.gif", width=96, height=72)) as pictures:
        assert pictures.size == (96, 72) and pictures.n_frames == 4  # the start, and after 2, 4, 5 steps


@pytest.mark.parametrize("task", ["aligning", "po_sorting", "stacking_1"])
def test_film_starts_from_the_context(task, tmp_path):
    contexts = pytest.importorskip("torchrl_koap.envs.contexts")
    table = contexts.evaluation_contexts(task)
    width = get_task(task).action_dim
    frames = []
    for row in (0, 0, 1):
        path = film(torch.zeros(1, width), tmp_path / "a.gif", task=task, context=table[row], width=96, height=72)
        with Image.open(path) as pictures:
            frames.append(np.asarray(pictures.convert("RGB")).astype(int))
    assert (frames[0] == frames[1]).all() and (np.abs(frames[0] - frames[2]) > 50).any()


def test_film_of_a_long_rollout_has_few_pictures(tmp_path):
    path = film(torch.zeros(60, 2), tmp_path / "a.gif", width=32, height=24)
    with Image.open(path) as pictures:
        assert pictures.n_frames == 21 and pictures.info["duration"] == 70  # every third step


def test_film_needs_its_packages_task_and_context(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="did you mean 'sorting'"):
        render_rollout(torch.zeros(3, 2), tmp_path / "a.gif", task="sortin")
    with pytest.raises(ValueError, match="a film needs the 'context'"):
        render_rollout(torch.zeros(3, 2), tmp_path / "a.gif", task="sorting")
    with pytest.raises(ValueError, match=r"'context' must have shape \[4, 3\]"):
        render_rollout(torch.zeros(3, 2), tmp_path / "a.gif", task="sorting", context=np.zeros((2, 3)))
    monkeypatch.setattr("torchrl_koap.reports.animation.importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="pip install imageio imageio-ffmpeg"):
        render_rollout(torch.zeros(3, 2), tmp_path / "a.mp4")
