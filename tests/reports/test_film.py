# This source code is licensed under the MIT license found in the LICENSE file.
"""Films of recorded actions start where the rollout did, and hold few frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from run_files import make_object_rollouts, make_rollouts

from torchrl_koap.reports import film as film_module
from torchrl_koap.reports.film import film_actions, film_rollout
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.writing import Film
from torchrl_koap.tasks import get_task


def frames_of(actions, task, **options):
    try:
        film = film_actions(actions, get_task(task), **options)
    except RuntimeError as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")
    return film.frames


def test_film_of_recorded_actions():
    actions = np.full((6, 2), 0.008)
    actions[5] = np.nan
    frames = frames_of(actions, "avoiding", width=96, height=72)
    assert len(frames) == 4 and frames[0].shape == (72, 96, 3)  # the start, and after 2, 4, 5 steps


@pytest.mark.parametrize("task", ["aligning", "po_sorting", "stacking_1"])
def test_film_starts_from_the_context(task):
    contexts = pytest.importorskip("torchrl_koap.envs.contexts")
    table, actions = contexts.evaluation_contexts(task), np.zeros((1, get_task(task).action_dim))
    first, again, other = (
        frames_of(actions, task, context=table[row], width=96, height=72)[0].astype(int) for row in (0, 0, 1)
    )
    assert (first == again).all() and (np.abs(first - other) > 50).any()


def test_film_of_a_long_rollout_has_few_frames():
    assert len(frames_of(np.zeros((60, 2)), "avoiding", width=32, height=24)) == 21  # every third step


def test_film_needs_its_context():
    with pytest.raises(ValueError, match="a film needs the 'context'"):
        film_actions(np.zeros((3, 2)), get_task("sorting"))
    with pytest.raises(ValueError, match=r"'context' must have shape \[4, 3\]"):
        film_actions(np.zeros((3, 2)), get_task("sorting"), context=np.zeros((2, 3)))


@pytest.mark.parametrize("task", ["avoiding", "stacking_1"])
def test_the_first_success_is_filmed(task, monkeypatch):
    made = []
    monkeypatch.setattr(film_module, "film_actions", lambda *what, **how: made.append((what, how)) or Film([], 0.1))
    rollouts = make_rollouts() | {"action": np.random.rand(4, 20, 2)}
    if task != "avoiding":
        rollouts = make_object_rollouts(task)
    rollouts["outcome"] = np.array([0, 0, 1, 1])
    film_rollout(rollouts, RunFacts(Path("run"), get_task(task)))
    (((actions, of), options),) = made
    np.testing.assert_array_equal(actions, rollouts["action"][2])
    assert of.name == task
    assert (options["context"] is None) if task == "avoiding" else options["context"].dtype == np.float64
