# This source code is licensed under the MIT license found in the LICENSE file.
"""A bowl that stands somewhere else in every episode: contexts, physics, outcome, recordings."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_koap.data.formats.lerobot_frames import read_image_episodes
from torchrl_koap.envs.contexts import check_contexts, draw_contexts
from torchrl_koap.envs.registry import make_env
from torchrl_koap.envs.scooping.expert import ScoopingExpert, start_joints
from torchrl_koap.envs.scooping.recording import record_videos
from torchrl_koap.envs.scooping.simulation import ScoopingSimulations
from torchrl_koap.tasks import get_task
from torchrl_koap.tasks.scooping import BOWL, BOWL_REACH, RIM_RADIUS, START_HALF, STARTS, start_of
from torchrl_koap.vision import projection_of

TASK = get_task("scooping_moving_bowl")
CORNERS = [(BOWL[0] + i * BOWL_REACH[0], BOWL[1] + j * BOWL_REACH[1]) for i in (-1, 1) for j in (-1, 1)]
ONE = np.arange(1)


def context_at(bowl, start="near", turn=0.4):
    return np.array([[*STARTS[start], turn], [*bowl, 0.0]])


def play(context, targets=None):
    """An episode of the expert, or of given targets; the targets and the simulation."""
    sims = ScoopingSimulations("robot", 1)
    sims.reset(ONE, start_joints(context, "robot")[None], [context[0, 2]], context[None, 1, :2])
    if targets is not None:
        for target in targets:
            sims.advance(ONE, target[None])
        return targets, sims
    expert, targets = ScoopingExpert(sims, 0, start_of(context), 0), []
    while not sims.success[0] and len(targets) < 120:
        targets.append(expert.target())
        sims.advance(ONE, targets[-1][None])
    return targets, sims


def test_a_context_has_the_spoon_at_one_of_its_starts_and_the_bowl_anywhere_in_its_region():
    contexts = draw_contexts(TASK, 200, 0)
    starts = [start_of(context) for context in contexts]
    assert sorted(set(starts)) == [0, 1, 2] and min(map(starts.count, (0, 1, 2))) > 40
    offsets = contexts[:, 0, :2] - np.array(list(STARTS.values()))[starts]
    assert np.abs(offsets).max() <= START_HALF
    moved = (contexts[:, 1, :2] - BOWL) / BOWL_REACH
    assert np.abs(moved).max() <= 1 and np.abs(moved).max(0).min() > 0.95
    with pytest.raises(ValueError, match="context 0 puts 'bowl' at"):
        check_contexts(TASK, context_at(STARTS["left"])[None])
    with pytest.raises(ValueError, match="context 0 puts 'spoon' at"):
        check_contexts(TASK, contexts[:1, ::-1])


def test_the_bowl_and_its_pieces_stand_where_the_context_says():
    env = make_env(TASK, 2, embed=False)
    check_env_specs(env)
    contexts = np.stack([context_at(CORNERS[0]), context_at(CORNERS[3], "left")])
    start = env.reset(contexts=contexts)
    bowls = start["observation"][:, TASK.observation["bowl"]].numpy()
    np.testing.assert_allclose(bowls, contexts[:, 1, :2], atol=1e-6)
    spread = np.linalg.norm(env.sims.piece_positions[..., :2] - contexts[:, None, 1, :2], axis=-1)
    assert spread.max() < RIM_RADIUS
    hold = torch.tensor(env.commands, dtype=torch.float32)
    for _ in range(10):
        env.step(start.set("action", hold))
    after = np.linalg.norm(env.sims.piece_positions[..., :2] - contexts[:, None, 1, :2], axis=-1)
    assert np.abs(after - spread).max() < 2e-3  # they rest there


@pytest.mark.parametrize("bowl", CORNERS)
def test_the_expert_finds_the_bowl_wherever_it_stands(bowl):
    _, sims = play(context_at(bowl))
    assert sims.success[0] and sims.rim[0]


def test_what_takes_a_piece_out_of_one_bowl_is_not_even_over_the_rim_of_another():
    targets, sims = play(context_at(CORNERS[0]))
    assert sims.success[0]
    _, elsewhere = play(context_at(CORNERS[3]), targets)
    assert not elsewhere.rim[0] and not elsewhere.success[0]


def test_a_saved_state_knows_where_the_bowl_stands():
    env, other = (make_env(TASK, 1, embed=False) for _ in range(2))
    data = env.reset(contexts=context_at(CORNERS[1])[None])
    other.reset(contexts=context_at(CORNERS[2])[None])
    other.set_state(0, env.get_state(0))
    np.testing.assert_array_equal(other.sims.bowl_positions, env.sims.bowl_positions)
    action = torch.tensor(env.commands + 0.02, dtype=torch.float32)
    ends = [each.step(data.clone().set("action", action))["next", "observation"] for each in (env, other)]
    assert torch.equal(*ends)


def test_recordings_hold_the_bowl_s_place(tmp_path):
    try:
        record_videos(tmp_path / "set", "hand", 2, task=TASK)
    except RuntimeError as error:
        pytest.skip(f"no OpenGL library: {error}")
    episodes = read_image_episodes(tmp_path / "set")
    places = [episode.state[:, 3:] for episode in episodes]
    assert all(place.shape == (len(e.frames), 2) for place, e in zip(places, episodes, strict=True))
    assert all(np.ptp(place, axis=0).max() == 0 for place in places) and not np.allclose(places[0][0], places[1][0])


def test_each_task_has_a_projection_of_its_own_and_others_none():
    assert projection_of("scooping") != projection_of(TASK.name)
    with pytest.raises(ValueError, match=r"task 'avoiding' \(only for scooping, scooping_moving_bowl\)"):
        projection_of("avoiding")
