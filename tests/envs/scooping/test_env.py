# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests Scooping: physics, outcome, absolute targets, the expert, and a bowl at random positions."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_koap.commands.data_commands import Demos
from torchrl_koap.data import read_recordings
from torchrl_koap.envs import ScoopingEnv
from torchrl_koap.envs.contexts import check_contexts, draw_contexts
from torchrl_koap.envs.mujoco.rendering import Renderer
from torchrl_koap.envs.registry import make_env
from torchrl_koap.envs.scooping.expert import ScoopingExpert, SpoonKinematics, start_episodes
from torchrl_koap.envs.scooping.recording import record_videos
from torchrl_koap.envs.scooping.simulation import ScoopingSimulations, settled_layouts
from torchrl_koap.tasks import get_task
from torchrl_koap.tasks.scooping import (
    BOWL,
    BOWL_REACH,
    EMBEDDING_DIM,
    PIECE_RADIUS,
    RIM_RADIUS,
    START_HALF,
    START_HEIGHT,
    STARTS,
    scores,
    start_of,
)
from torchrl_koap.vision import Backbone, FrozenImageEncoder, Projection
from torchrl_koap.vision.encoder import projection_of

NEAR = np.array([[*STARTS["near"], 0.4]])
MOVING = get_task("scooping_moving_bowl")
CORNERS = [(BOWL[0] + i * BOWL_REACH[0], BOWL[1] + j * BOWL_REACH[1]) for i in (-1, 1) for j in (-1, 1)]
ONE = np.arange(1)


def context_at(bowl, start="near"):
    return np.array([[*STARTS[start], 0.4], [*bowl, 0.0]])


def play(embodiment, context=NEAR, targets=None):
    """An episode of the expert, or of given targets; the targets and the simulation."""
    sims = ScoopingSimulations(embodiment, 1)
    start_episodes(sims, ONE, context[None], SpoonKinematics())
    if targets is not None:
        for target in targets:
            sims.advance(ONE, target[None])
        return targets, sims
    expert, targets = ScoopingExpert(sims, 0, start_of(context), 0), []
    while not sims.success[0] and len(targets) < 120:
        targets.append(expert.target())
        sims.advance(ONE, targets[-1][None])
    return np.stack(targets), sims


def test_pieces_rest_in_the_bowl():
    layouts = settled_layouts()
    assert layouts.shape[1:] == (36, 3)
    assert np.linalg.norm(layouts[..., :2] - BOWL, axis=-1).max() < RIM_RADIUS
    assert layouts[..., 2].min() > 0.9 * PIECE_RADIUS  # none has sunk


def test_specs_and_start():
    env = ScoopingEnv(num_envs=2, seed=0, embed=False)
    check_env_specs(env)
    contexts = draw_contexts("scooping", 2, 3)
    start = env.reset(contexts=contexts)
    spoon = start["observation"][:, get_task("scooping").observation["spoon"]].numpy()
    np.testing.assert_allclose(spoon[:, :2], contexts[:, 0, :2], atol=2e-3)
    np.testing.assert_allclose(spoon[:, 2], START_HEIGHT, atol=2e-3)
    assert not start["success"].any() and not start["mode"].any()


def test_the_robot_s_demonstration_succeeds_in_the_environment_too():
    targets, sims = play("robot")
    assert sims.success[0] and sims.rim[0] and sims.pieces_on_spoon(0) >= 1
    env = ScoopingEnv(num_envs=1, embed=False)
    data = env.reset(contexts=NEAR[None])
    for target in targets:
        data = env.step(data.set("action", torch.tensor(target[None], dtype=torch.float32)))["next"]
    assert data["success"].item() and data["terminated"].item() and data["mode"].item()


def test_the_hand_succeeds_without_joints():
    targets, sims = play("hand", np.array([[*STARTS["left"], -1.0]]))
    assert sims.success[0] and targets.shape[1] == 6


def test_holding_still_is_no_success_and_the_spoon_stays_above_the_table():
    arm, env = SpoonKinematics(), ScoopingEnv(num_envs=1, embed=False)
    data = env.reset(contexts=NEAR[None])
    below = arm.solve(np.array([0.36, 0.15, -0.06]), np.eye(3), iterations=80)
    for _ in range(30):
        data = env.step(data.set("action", torch.tensor(below[None], dtype=torch.float32)))["next"]
    assert env.sims.spoon_position[0, 2] > -0.004  # pressed upon the table, not through it
    assert not data["success"].item() and not data["mode"].item()


def test_a_step_after_the_success_of_all_changes_nothing(graphics):
    env = ScoopingEnv(num_envs=2, embed=False, pixels=True)
    start = env.reset()
    env.sims.rim[:], env.sims.held[:] = True, 99
    first = env.step(start.clone().set("action", torch.zeros(2, 7)))["next"]
    second = env.step(first.clone().set("action", torch.ones(2, 7)))["next"]
    assert (first == second).all() and first["success"].all() and first["reward"].tolist() == [[1.0], [1.0]]


def test_a_piece_must_stay_on_the_spoon_after_it_was_low_over_the_bowl(monkeypatch):
    sims, carried = ScoopingSimulations("robot", 1), True
    monkeypatch.setattr(sims, "pieces_on_spoon", lambda row: int(carried))

    def at(*heights):
        for height in heights:
            sims._assess(0, SimpleNamespace(site_xpos={sims._site: (*BOWL, height)}, mocap_pos=[(*BOWL, 0.0)]))
        return bool(sims.rim[0]), bool(sims.success[0])

    assert at(*[0.2] * 9) == (False, False)  # it came from above and was never low
    assert at(0.08, *[0.095] * 5) == (True, False)
    carried = False
    assert at(0.095) == (True, False)  # the piece fell
    carried = True
    assert at(*[0.095] * 5) == (True, False) and at(0.095) == (True, True)


def test_targets_that_are_far_away_are_approached_at_a_limited_speed():
    env = ScoopingEnv(num_envs=1, embed=False)
    data = env.reset(contexts=NEAR[None])
    before = env.commands
    env.step(data.set("action", torch.tensor(before + 1.0, dtype=torch.float32)))
    np.testing.assert_allclose(np.abs(env.commands - before).max(), 0.25, atol=1e-6)
    for _ in range(25):
        env.step(data.set("action", torch.full((1, 7), 9.0)))
    np.testing.assert_allclose(env.commands[0], env.action_spec.high[0], atol=1e-6)  # the limits of the joints
    with pytest.raises(ValueError, match="must be finite"):
        env.step(data.set("action", torch.full((1, 7), torch.nan)))


def test_scores_tell_the_starts_apart():
    env = ScoopingEnv(num_envs=2, embed=False, max_steps=2)
    start = env.reset(contexts=np.array([[[0.5, 0.22, 0]], [[0.33, 0, 0]]]))
    episodes = list(env.rollout(2, auto_reset=False, tensordict=start))
    starts = {"success from left": [False], "success from near": [False]}
    assert scores({}, episodes, None) == {"rates": {"spoon over the bowl": [False, False], **starts}}


@pytest.mark.parametrize("embodiment", ["robot", "hand"])
def test_the_camera_sees_the_embodiments_differ(embodiment, graphics):
    renderer = Renderer(ScoopingSimulations(embodiment, 1).model, 96, 96, shadows=False)
    sims = ScoopingSimulations(embodiment, 1)
    start_episodes(sims, ONE, NEAR[None], SpoonKinematics())
    picture = renderer.render(sims.data[0], "third_person").astype(int)
    renderer.close()
    assert picture.shape == (96, 96, 3)
    skin = (picture[..., 0] > 150) & (picture[..., 0] - picture[..., 2] > 50) & (picture[..., 1] < 170)
    assert (skin.sum() > 40) == (embodiment == "hand")


def test_frames_are_embedded_in_the_environment_or_by_a_transform(graphics):
    backbone = Backbone(torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(7), torch.nn.Flatten()), "mean colours", "own")
    encoder = FrozenImageEncoder(backbone, projection=Projection.fit(torch.rand(200, 147), EMBEDDING_DIM))
    env = TransformedEnv(ScoopingEnv(2, seed=0, encoder=encoder, pixels=True), encoder)
    check_env_specs(env)
    data = env.rollout(2)
    for frame in (data, data["next"]):
        torch.testing.assert_close(frame["embedding"], encoder.embed(frame["pixels"]))
        torch.testing.assert_close(frame["observation"][..., :EMBEDDING_DIM], frame["embedding"])
    encoder.projection = None
    with pytest.raises(ValueError, match=f"must have {EMBEDDING_DIM} components, got 0"):
        ScoopingEnv(2, encoder=encoder)


def test_the_embodiment_is_mandatory(tmp_path):
    with pytest.raises(ValueError, match="--embodiment robot or hand"):
        Demos(out=tmp_path / "a", task="scooping")()
    with pytest.raises(ValueError, match="unknown embodiment 'foot'"):
        Demos(out=tmp_path / "a", task="scooping", embodiment="foot")()
    with pytest.raises(ValueError, match="has only one embodiment"):
        Demos(out=tmp_path / "a", task="avoiding", embodiment="hand")()
    assert not (tmp_path / "a").exists()


def test_recordings_are_repeatable_and_an_unfinished_one_is_no_data_set(tmp_path, graphics):
    record, seen = functools.partial(record_videos, embodiment="robot", episodes=1), []

    def interrupt(number, total):
        raise KeyboardInterrupt

    report = record(tmp_path / "whole", progress=lambda number, total: seen.append(number))
    assert seen == [1] and report.episodes == 1 and report.attempts >= 1
    assert str(report).startswith(f"1 demonstrations by a robot, {report.frames} frames; ")
    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "parts", progress=interrupt)
    with pytest.raises(ValueError, match="holds no recordings that can be read"):
        read_recordings(tmp_path / "parts")
    with pytest.raises(FileExistsError, match="is not empty; choose another folder"):
        record(tmp_path / "parts")
    record(tmp_path / "again")
    one, other = (read_recordings(tmp_path / name) for name in ("again", "whole"))
    np.testing.assert_array_equal(one.actions[0], other.actions[0])
    np.testing.assert_array_equal(*(list(each.cameras["third_person"][0].read()) for each in (one, other)))


def test_a_recording_ends_after_the_steps_of_the_task(tmp_path, graphics):
    short = replace(get_task("scooping"), max_steps=3)
    with pytest.raises(RuntimeError, match="the hand never succeeded in 10 attempts"):
        record_videos(tmp_path / "set", "hand", 1, task=short)


def test_a_context_has_the_spoon_at_one_of_its_starts_and_the_bowl_anywhere_in_its_region():
    contexts = draw_contexts(MOVING, 200, 0)
    starts = [start_of(context) for context in contexts]
    assert sorted(set(starts)) == [0, 1, 2] and min(map(starts.count, (0, 1, 2))) > 40
    offsets = contexts[:, 0, :2] - np.array(list(STARTS.values()))[starts]
    assert np.abs(offsets).max() <= START_HALF
    moved = (contexts[:, 1, :2] - BOWL) / BOWL_REACH
    assert np.abs(moved).max() <= 1 and np.abs(moved).max(0).min() > 0.95
    with pytest.raises(ValueError, match="context 0 puts 'bowl' at"):
        check_contexts(MOVING, context_at(STARTS["left"])[None])
    with pytest.raises(ValueError, match="context 0 puts 'spoon' at"):
        check_contexts(MOVING, contexts[:1, ::-1])


def test_the_bowl_and_its_pieces_stand_where_the_context_says():
    env = make_env(MOVING, 2, embed=False)
    check_env_specs(env)
    contexts = np.stack([context_at(CORNERS[0]), context_at(CORNERS[3], "left")])
    start = env.reset(contexts=contexts)
    bowls = start["observation"][:, MOVING.observation["bowl"]].numpy()
    np.testing.assert_allclose(bowls, contexts[:, 1, :2], atol=1e-6)
    spread = np.linalg.norm(env.sims.piece_positions[..., :2] - contexts[:, None, 1, :2], axis=-1)
    assert spread.max() < RIM_RADIUS
    hold = torch.tensor(env.commands, dtype=torch.float32)
    for _ in range(10):
        env.step(start.set("action", hold))
    after = np.linalg.norm(env.sims.piece_positions[..., :2] - contexts[:, None, 1, :2], axis=-1)
    assert np.abs(after - spread).max() < 2e-3  # they rest there


def test_actions_that_succeed_with_one_bowl_fail_with_another():
    targets, sims = play("robot", context_at(CORNERS[0]))
    assert sims.success[0]
    _, elsewhere = play("robot", context_at(CORNERS[3]), targets)
    assert not elsewhere.rim[0] and not elsewhere.success[0]
    assert play("robot", context_at(CORNERS[3]))[1].success[0]


def test_a_saved_state_holds_the_position_of_the_bowl():
    env, other = (make_env(MOVING, 1, embed=False) for _ in range(2))
    data = env.reset(contexts=context_at(CORNERS[1])[None])
    other.reset(contexts=context_at(CORNERS[2])[None])
    other.set_state(0, env.get_state(0))
    np.testing.assert_array_equal(other.sims.bowl_positions, env.sims.bowl_positions)
    action = torch.tensor(env.commands + 0.02, dtype=torch.float32)
    ends = [each.step(data.clone().set("action", action))["next", "observation"] for each in (env, other)]
    assert torch.equal(*ends)


def test_recordings_hold_the_bowl_s_place(tmp_path, graphics):
    record_videos(tmp_path / "set", "hand", 2, task=MOVING)
    recordings = read_recordings(tmp_path / "set", action_dim=MOVING.action_dim)
    places, clips = [states[:, 3:] for states in recordings.states], recordings.cameras["third_person"]
    assert [place.shape for place in places] == [(len(list(clip.read())), 2) for clip in clips]
    assert all(np.ptp(place, axis=0).max() == 0 for place in places) and not np.allclose(places[0][0], places[1][0])


def test_each_task_has_a_projection_of_its_own_and_others_none():
    assert projection_of("scooping") != projection_of(MOVING.name)
    with pytest.raises(ValueError, match=r"task 'avoiding' \(only for scooping, scooping_moving_bowl\)"):
        projection_of("avoiding")
