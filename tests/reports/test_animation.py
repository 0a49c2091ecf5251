# This source code is licensed under the MIT license found in the LICENSE file.
"""Moving pictures from above: what is in them, how many frames, and how they are written."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from run_files import make_object_rollouts, make_rollouts, run_of

from torchrl_koap.reports.animation import animate_rollouts
from torchrl_koap.reports.pictures import NothingToDraw, save_film

RUN = run_of("avoiding")


def test_animation_shows_every_step_and_holds_the_end(tmp_path):
    path = save_film(animate_rollouts(make_rollouts(), RUN), tmp_path / "a.gif")
    with Image.open(path) as film:
        assert film.n_frames == 11 and film.info["duration"] == 70  # steps 0, 2, ..., 18, 19; 2 x 35 ms
        first = np.asarray(film.convert("L")).astype(int)
        film.seek(10)
        assert film.info["duration"] == 1500
        assert (np.abs(np.asarray(film.convert("L")).astype(int) - first) > 60).sum() > 500
    assert path.stat().st_size < 2e6


def test_objects_move_in_the_animation():
    """A box that nothing else covers is drawn where it is: red pixels at its last place, none at its first."""
    run = run_of("stacking")
    first, *_, last = animate_rollouts(make_object_rollouts("stacking", episodes=1), run).frames
    red = [(frame[..., 0] > 180) & (frame[..., 1:] < 70).all(-1) for frame in (first.astype(int), last.astype(int))]
    assert red[0].sum() > 10 and red[1].sum() > 10 and not (red[0] & red[1]).any()
    assert np.argwhere(red[0])[:, 0].mean() > np.argwhere(red[1])[:, 0].mean() + 50  # it moves away, up in the picture


def test_long_animations_skip_steps():
    long = {"position": np.random.rand(1, 1000, 2), "length": [1000], "mode": [0], "outcome": [1]}
    film = animate_rollouts(long, RUN)
    assert film.seconds == pytest.approx(6 * 0.035) and len(list(film.frames)) <= 171


def test_no_rollouts():
    none = {"position": np.zeros((0, 5, 2)), "length": [], "mode": [], "outcome": []}
    with pytest.raises(NothingToDraw, match="no rollouts"):
        animate_rollouts(none, RUN)
