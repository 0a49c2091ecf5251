# This source code is licensed under the MIT license found in the LICENSE file.
"""Plays first attempts of scripted experts; base class of their tests, which a test file per expert subclasses."""

import numpy as np
import pytest
import torch

from torchrl_koap.envs import make_env
from torchrl_koap.envs.contexts import draw_contexts, evaluation_contexts
from torchrl_koap.envs.experts.disturbances import Disturbances
from torchrl_koap.envs.experts.recording import play
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.tasks import get_task


def first_attempts(task, modes, contexts, seeds, max_steps=None):
    """Plays the first attempt at every mode; returns the attempts and the environment in its final state."""
    task = get_task(task)
    env = make_env(task, len(modes), max_steps=max_steps or task.max_steps, dtype=torch.float64)
    still = Disturbances(task, seeds, [False] * len(modes))
    return play(env, task, modes, contexts, seeds, lambda over: None, still), env


class ExpertTestBase:
    """Tests that an episode depends on its seed alone."""

    TASK: str
    EXPERT: type
    MODES = (0, 1)  # two different ones
    TOLERANCE = 0.0  # largest allowed difference of actions between batches

    def actions(self, modes, seeds, contexts):
        found, _ = first_attempts(self.TASK, modes, contexts, seeds, max_steps=60)
        return np.stack([attempt.actions for attempt in found])

    def test_an_episode_depends_on_its_seed_alone(self):
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002
        before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
        task = get_task(self.TASK)
        drawn = draw_contexts(task, 2, 2) if task.objects else None
        first, second = self.MODES
        both = self.actions([first, second, second], [5, (3, 1), (3, 2)], None if drawn is None else drawn[[0, 1, 1]])
        alone = self.actions([second], [(3, 1)], None if drawn is None else drawn[1:])
        np.testing.assert_allclose(both[1], alone[0], rtol=0, atol=self.TOLERANCE)
        assert np.abs(both[2] - both[1]).max() > 1e-4
        assert torch.equal(torch.random.get_rng_state(), before[0])
        assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


class ContextExpertTestBase(ExpertTestBase):
    """Adds a test for tasks with objects: most first attempts succeed in the requested mode."""

    VARIANTS: dict[str, float] = {}  # further tasks of the expert, with the least share of good first attempts

    @pytest.mark.slow
    @pytest.mark.timeout(900)
    def test_nine_of_ten_first_attempts_succeed_in_the_asked_mode(self):
        for task, share in ({self.TASK: 0.9} | self.VARIANTS).items():
            modes = get_task(task).modes.number
            for contexts in (evaluation_contexts(task), draw_contexts(task, 60, 11)):
                wanted = np.arange(60) % modes
                found, _ = first_attempts(task, wanted, contexts, [(2, row) for row in range(60)])
                good = np.array([not attempt.fault for attempt in found])
                assert good.mean() >= share, (task, wilson_interval(int(good.sum()), 60))
                assert set(wanted[good]) == set(range(modes)), task
