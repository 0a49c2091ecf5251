# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests tasks from outside the package: the tutorial's, with simulator and expert, and one with data alone."""

import sys
import types
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from small_networks import plain_task
from torchrl.envs.utils import check_env_specs

from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.envs import make_env
from torchrl_koap.envs.contexts import check_contexts, draw_contexts, evaluation_contexts
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.evaluation.diagnosis import contexts_of
from torchrl_koap.evaluation.scores import score
from torchrl_koap.keys import validate
from torchrl_koap.reports.pictures import all_pictures
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.scenes import BLUE, bodies_of, draw_scene
from torchrl_koap.tasks import TASKS, get_task, register_task

TUTORIAL = Path(__file__).parents[2] / "tutorials" / "own_task.py"
NAME = "push_past_a_post"


@pytest.fixture(scope="module", autouse=True)
def plugin():
    """The task, registered by import, for the tests of this file alone."""
    own = types.ModuleType("own_task")
    with patch.dict(TASKS), pytest.MonkeyPatch.context() as context:
        context.setitem(sys.modules, "own_task", own)
        definitions, training, _ = TUTORIAL.read_text().partition("# Record, train, roll out")
        assert training, f"{TUTORIAL.name}: the heading behind the definitions has another name"
        exec(compile(definitions, TUTORIAL, "exec"), vars(own))
        yield


@pytest.fixture(scope="module")
def demonstrations():
    return record_demonstrations(NAME, episodes=12, seed=1)


def test_the_environment_is_what_torchrl_expects():
    env = make_env(NAME, 3, max_steps=20)
    check_env_specs(env)
    contexts = draw_contexts(NAME, 3, 0)
    np.testing.assert_allclose(env.reset(contexts=contexts)["observation"][:, 2:], contexts[:, 0, :2], rtol=1e-6)


def test_the_expert_records_both_modes(demonstrations):
    data, report = demonstrations
    validate(data)
    assert report.each("mode") == [0, 1] * 6 and report.task.modes.number == 2
    assert trajectory_lengths(data).tolist() == report.each("rows")  # every step is kept, none lost to a conversion
    # the robot moves as told, inside every trajectory
    moved = data["next", "observation"][:, :2] - data["observation"][:, :2]
    torch.testing.assert_close(moved, data["action"], rtol=0, atol=1e-6)
    task, last = get_task(NAME), data["next", "done"].squeeze(-1)
    assert task.goal_reached(task.state_of(data["next", "observation"][last])).all()
    again, _ = record_demonstrations(NAME, episodes=12, seed=1)
    assert torch.equal(again["action"], data["action"])


def test_contexts_come_from_the_task():
    table = evaluation_contexts(NAME)
    assert table.shape == (60, 1, 3) and np.array_equal(table, evaluation_contexts(NAME))
    task = get_task(NAME)
    np.testing.assert_array_equal(check_contexts(task, table), table)
    with pytest.raises(ValueError, match=r"context 0 puts 'puck' at \(0.9, 0.07\) m, outside its region: x 0.4..0.6"):
        check_contexts(task, [[[0.9, 0.07, 0.0]]])
    frames = make_env(NAME, 2).reset(contexts=table[:2])["observation"]
    np.testing.assert_allclose(contexts_of(task, frames)[:, 0, :2], table[:2, 0, :2], rtol=1e-6)


def test_modes_scores_and_goal():
    task = get_task(NAME)
    assert [task.modes.name_of(mode) for mode in (0, 1, -1)] == ["left", "right", "no mode"]
    assert task.modes.index_of(torch.tensor([[1], [-1]])).tolist() == [1, -1]
    env = make_env(task, 4, max_steps=5)
    episodes = list(env.rollout(5, break_when_any_done=False))
    result = score(episodes, range(4), task.modes, contexts=[0, 0, 1, 1])
    assert result["rates"]["success"]["rate"] == 0.0 and result["episodes"] == 4
    assert task.goal_reached(torch.tensor([[0.0, 0.0, 0.5, 0.4], [0.5, 0.4, 0.0, 0.0]])).tolist() == [True, False]


def test_it_is_drawn():
    run = RunFacts(Path(), get_task(NAME))
    axes = draw_scene(Figure().add_subplot(), run.task)
    assert [round(patch.get_radius(), 3) for patch in axes.patches] == [0.05, 0.01]
    assert axes.texts[0].get_text() == "goal" and axes.get_xlim() == (0.25, 0.75)
    (look,) = bodies_of(run.task, 1)
    assert look.label == "puck" and to_rgb(look.color) == to_rgb(BLUE)
    assert "Squares are the objects" in all_pictures()["rollouts.gif"].caption_for(run)


def test_a_robot_without_simulator():
    task = register_task(plain_task(9, 7))
    assert task.tool_columns is None and task.tool_position is None and task.gripper is None and task.modes.number == 1
    for ask in (make_env, lambda known: record_demonstrations(known.name, episodes=1)):
        with pytest.raises(ValueError, match="task 'plain' has no (environment|scripted expert)"):
            ask(task)
    with pytest.raises(ValueError, match="task 'plain' has no goal"):
        task.goal_reached(torch.zeros(1, 9))
    with pytest.raises(ValueError, match="task 'plain' has no contexts"):
        evaluation_contexts(task)
    draw_scene(Figure().add_subplot(), task)
