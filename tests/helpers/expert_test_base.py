# This source code is licensed under the MIT license found in the LICENSE file.
"""Episodes of a scripted expert, and what every expert has to do; a test file per expert subclasses the base."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.envs import make_env
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.tasks import get_task


def play(env, expert, contexts=None, steps=1000, to_the_end=False):
    """Plays one episode per environment; one that is over stands still.

    With ``to_the_end`` it is over when the expert has finished, else with the environment too. Returns the last leaves
    ``out``, ``actions`` [T, n, act], ``seen`` observations [T, n, obs], and [n] each ``lengths``, ``success`` and the
    control step ``told`` at which success was told, -1 if never.
    """
    count = env.batch_size[0]
    out = env.reset() if contexts is None else env.reset(contexts=contexts)
    running, lengths, told = np.ones(count, dtype=bool), np.zeros(count, dtype=int), np.full(count, -1)
    actions, seen = [], []
    for step in range(steps):
        seen.append(out["observation"].numpy().copy())
        actions.append(expert.act(seen[-1]))
        running &= ~expert.finished
        if not running.any():
            break
        mask = torch.from_numpy(running.copy())[:, None]
        out = env.step(TensorDict({"action": torch.from_numpy(actions[-1]), "_step": mask}, [count]))["next"]
        lengths += running
        told[(told < 0) & out["success"][:, 0].numpy()] = step + 1
        if not to_the_end:
            running &= ~out["done"][:, 0].numpy()
            if not running.any():
                break
    success = out["success"][:, 0].numpy()
    return SimpleNamespace(
        out=out, actions=np.stack(actions), seen=np.stack(seen), lengths=lengths, told=told, success=success
    )


class ExpertTestBase:
    """An episode depends on its seed alone, and what does not fit is refused."""

    TASK: str
    EXPERT: type
    MODES = (0, 1)  # two different ones
    TOLERANCE = 0.0  # by which actions may depend on the batch

    def actions(self, modes, seeds, contexts):
        env = make_env(self.TASK, len(modes), dtype=torch.float64)
        return play(env, self.EXPERT(modes=modes, contexts=contexts, seeds=seeds), contexts, 60).actions

    def test_an_episode_depends_on_its_seed_alone(self):
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002
        before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
        env = make_env(self.TASK)
        drawn = draw_contexts(env.task, 2, 2) if env.task.objects else None
        first, second = self.MODES
        both = self.actions([first, second, second], [5, (3, 1), (3, 2)], None if drawn is None else drawn[[0, 1, 1]])
        alone = self.actions([second], [(3, 1)], None if drawn is None else drawn[1:])
        np.testing.assert_allclose(both[:, 1], alone[:, 0], rtol=0, atol=self.TOLERANCE)
        assert np.abs(both[:, 2] - both[:, 1]).max() > 1e-4
        assert torch.equal(torch.random.get_rng_state(), before[0])
        assert np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002

    def test_what_does_not_fit_is_refused(self):
        task, (first, second) = get_task(self.TASK), self.MODES
        drawn, width = draw_contexts(task, 2, 0) if task.objects else None, task.observation_dim

        def make(modes, seeds, contexts=drawn):
            return self.EXPERT(modes=modes, contexts=contexts, seeds=seeds)

        with pytest.raises(ValueError, match="2 modes.* 1 seeds"):
            make([first, second], [0])
        with pytest.raises(ValueError, match=r"at least one|must be \[C, "):
            make([], [], None if drawn is None else drawn[:0])
        with pytest.raises(ValueError, match=r"modes? .* 0 .* got \[?99"):
            make([first, 99], [0, 1])
        with pytest.raises(ValueError, match=rf"shape \[2, {width}\], got \[2, {width + 1}\]"):
            make([first, second], [0, 1]).act(np.zeros((2, width + 1)))
        if drawn is not None:
            with pytest.raises(ValueError, match=r"\[2, .*, 2\]"):
                make([first, second], [0, 1], drawn[..., :2])
