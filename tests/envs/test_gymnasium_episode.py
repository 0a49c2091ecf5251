# This source code is licensed under the MIT license found in the LICENSE file.
"""An environment of Gymnasium plays one episode: inside its box, to its end, whatever it raises."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from toy_gym import Breaks, Reach

from torchrl_koap.envs.gymnasium_episode import GymnasiumEpisode

PUSH = np.full(2, 0.1, dtype=np.float32)


def played(env, steps, seed=0):
    env.reset(seed=seed)
    return [env.step(PUSH) for _ in range(steps)]


def test_an_action_outside_the_box_is_clipped_and_told():
    env, alone = (GymnasiumEpisode(Reach(), 0, max_steps=9), Reach())
    env.reset(seed=3)
    alone.reset(seed=3)
    given = np.array([5.0, 0.5], dtype=np.float32)
    observation, *_, told = env.step(given)
    np.testing.assert_allclose(observation, alone.step(np.array([1.0, 0.5]))[0], rtol=1e-6)
    assert told["clipped"] and not env.step(PUSH)[-1]["clipped"]


def test_rounding_of_float32_is_no_clipping():
    env = Reach()
    env.action_space = gymnasium.spaces.Box(-0.1, 0.1, (2,), np.float64)
    env = GymnasiumEpisode(env, 0, max_steps=9)
    env.reset(seed=0)
    assert float(PUSH[0]) > 0.1 and not env.step(PUSH)[-1]["clipped"]


def test_an_error_in_a_step_ends_the_episode():
    told = [step[-1] for step in played(GymnasiumEpisode(Breaks(at=2), 0, max_steps=9), 3)]
    assert [each["error"] for each in told] == ["", "ZeroDivisionError: division by zero", ""]
    assert [each["over"] for each in told] == [False, True, True] and not told[-1]["success"]
    assert told[1]["truncated"] and not told[1]["terminated"]


@pytest.mark.parametrize(("said", "wanted"), [("False", False), ("true", True), (np.array([True]), True), (0, False)])
def test_success_may_be_said_in_words(said, wanted):
    env = GymnasiumEpisode(Reach(), 0, max_steps=9)
    assert env._succeeded({"is_success": said}, 0.0, False) is wanted
