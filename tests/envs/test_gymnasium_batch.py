# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests batches of Gymnasium environments with separate seeds, ends and successes."""

import functools
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs
from toy_gym import NAMES, Breaks, Reach, Seen

from torchrl_koap.envs.gymnasium_batch import EpisodeRecord, GymnasiumBatch
from torchrl_koap.envs.gymnasium_episode import GymnasiumEpisode
from torchrl_koap.tasks import Action, Task
from torchrl_koap.vision import FrozenImageEncoder, Observer, Projection, load_backbone
from torchrl_koap.vision.backbones import MEAN, STD

TASK = Task(
    name="arm", observation_parts={"arm": NAMES}, actions={"a": Action("rad"), "b": Action("rad")}, position="arm"
)
PUSH = 0.1


def registered():
    """The class that is made: a test of plugins may have registered it anew."""
    return gymnasium.spec("ToyReach-v0").entry_point


def run(env, steps, seeds=None):
    if seeds is not None:
        env.seed_episodes(seeds)
    env.reset()
    frames = []
    for _ in range(steps):
        action = torch.full((*env.batch_size, 2), PUSH, requires_grad=True)  # as of a policy, outside of no_grad
        frames.append(env.step(TensorDict({"action": action}, env.batch_size))["next"])
    return torch.stack(frames, 1)


def test_specs():
    check_env_specs(GymnasiumBatch("toy_gym:ToyReach-v0", TASK, 2))


def test_numbers_are_those_of_the_environment_itself():
    rollout = run(GymnasiumBatch("ToyReach-v0", TASK, 3), 5, [4, 9, 4])
    alone = Reach()
    first, _ = alone.reset(seed=9)
    rows = [alone.step(np.full(2, PUSH, dtype=np.float32))[0] for _ in range(5)]
    np.testing.assert_allclose(rollout["observation"][1].numpy(), np.stack(rows), rtol=1e-6)
    assert torch.equal(rollout["observation"][0], rollout["observation"][2])
    assert not torch.equal(rollout["observation"][0], rollout["observation"][1])


def test_a_seed_is_that_of_one_episode():
    env = GymnasiumBatch("ToyReach-v0", TASK, 2)
    env.seed_episodes([4, 9])
    first, second = (env.reset()["observation"] for _ in range(2))
    assert (first != second).any(-1).all()  # the environment's own generator goes on
    env.seed_episodes([4, 9])
    assert torch.equal(env.reset()["observation"], first)
    env.set_seed(8)
    assert torch.equal(env.reset()["observation"][1], first[1])  # the second environment has the next seed


def test_origins_of_the_data_are_subtracted_from_observations_and_added_to_actions():
    origin = np.array([1e6, -1e6, 0.0, 3.0])

    box = functools.partial(gymnasium.spaces.Box, -np.inf, np.inf, dtype=np.float64)

    def make_far():
        env = gymnasium.wrappers.TransformObservation(Reach(), lambda near: near + origin, box(shape=(4,)))
        return gymnasium.wrappers.TransformAction(env, lambda action: action - origin[:2], box(shape=(2,)))

    gymnasium.register("ToyFar-v0", make_far, disable_env_checker=True)
    targets = {name: Action("rad", "absolute", column=column) for column, name in enumerate("ab")}
    task = replace(TASK, actions=targets, observation_origin=tuple(origin))
    far, near = (
        run(GymnasiumBatch("ToyFar-v0", task, 2), 4, [4, 9]),
        run(GymnasiumBatch("ToyReach-v0", TASK, 2), 4, [4, 9]),
    )
    torch.testing.assert_close(far["observation"], near["observation"], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "key", "wanted"),
    [
        ("ToyReach-v0", None, [False, False, True, True, True, True]),
        ("ToyReach-v0", "is_success", [False, False, True, True, True, True]),
        ("ToyReachOwnKey-v0", "arrived", [False, False, True, True, True, True]),
        ("ToyReachOwnKey-v0", None, [False] * 6),
        ("ToyReachWon-v0", None, [False, False, True, True, True, True]),
        ("ToyReachLost-v0", None, [False] * 6),
        ("ToyReachFell-v0", None, [False] * 6),
    ],
)
def test_what_counts_as_success(name, key, wanted):
    rollout = run(GymnasiumBatch(name, TASK, 2, success_key=key), 6)
    assert rollout["success"][0].flatten().tolist() == wanted
    over = rollout["done"][0].flatten().tolist()
    ends = name in ("ToyReachWon-v0", "ToyReachLost-v0", "ToyReachFell-v0")
    assert over == ([False, False, True, True, True, True] if ends else [False] * 5 + [True])
    assert torch.equal(rollout["terminated" if ends else "truncated"], rollout["done"])
    assert not rollout["truncated" if ends else "terminated"].any()


def test_finished_environments_wait_for_their_reset():
    env = GymnasiumBatch("ToyReach-v0", TASK, 2, max_steps=4)
    assert env.max_steps == 4
    rollout = run(env, 6, [0, 1])
    assert rollout["truncated"][0].flatten().tolist() == [False] * 3 + [True] * 3
    assert torch.equal(rollout["observation"][:, 3], rollout["observation"][:, 5])
    again = env.reset(rollout[:, -1].exclude("reward").set("_reset", torch.tensor([[True], [False]])))
    assert again["done"].flatten().tolist() == [False, True]
    assert torch.equal(again["observation"][1], rollout["observation"][1, 5])
    assert not torch.equal(again["observation"][0], rollout["observation"][0, 5])


@pytest.mark.parametrize("processes", [False, True])
def test_environments_that_the_mask_leaves_out_wait(processes):
    record = EpisodeRecord()
    env = GymnasiumBatch("ToyReach-v0", TASK, 2, processes=processes, record=record)
    env.seed_episodes([4, 9])
    start, action = env.reset(), torch.full((2, 2), PUSH)
    masked = TensorDict({"action": action, "_step": torch.tensor([[True], [False]])}, [2])
    after, later = (env.step(each)["next"] for each in (masked, TensorDict({"action": action}, [2])))
    env.close()
    assert record.actions == 3 and not after["done"].any()
    assert torch.equal(after["observation"][1], start["observation"][1])
    steps = run(GymnasiumBatch("ToyReach-v0", TASK, 2), 2, [4, 9])["observation"]
    assert torch.equal(after["observation"][0], steps[0, 0])
    assert torch.equal(later["observation"], torch.stack([steps[0, 1], steps[1, 0]]))


def observer(*cameras):
    """Embeds a frame as the number of its first pixel."""
    parts = {"arm": ("x", "y")} | dict.fromkeys(cameras, 1)
    task = Task(name="arm", observation_parts=parts, actions={"a": Action(), "b": Action()}, position="arm")
    backbone = load_backbone("torch.nn:Flatten")
    about = FrozenImageEncoder(backbone, size=8).identity
    mean, std = (torch.tensor(values) for values in (MEAN, STD))
    offset, scale = -(mean / std).repeat_interleave(64), torch.zeros(192, 1)
    scale[0] = 255 * std[0]
    return task, Observer(task, {name: Projection(offset, scale, about) for name in cameras})


@pytest.mark.parametrize("cameras", [("front",), ("top", "wrist")])
def test_pictures_go_through_the_policy_s_own_transform(cameras):
    task, observe = observer(*cameras)
    make = functools.partial(gymnasium.make, "ToySeen-v0", **({} if len(cameras) == 1 else {"cameras": cameras}))
    gymnasium.register("ToySeenHere-v0", make, disable_env_checker=True)
    rollout = run(GymnasiumBatch("ToySeenHere-v0", task, 2, observe=observe), 2)
    wanted = [1.0, 2.0, 3.0] if len(cameras) == 1 else [1.0, 2.0, 3.0, 5.0]
    torch.testing.assert_close(rollout["observation"][0, 1], torch.tensor(wanted), rtol=1e-3, atol=1e-3)
    other, lacks = observer("left", "right")
    with pytest.raises(ValueError, match="camera 'left' has no picture; wanted uint8 pictures left, right and 2"):
        GymnasiumBatch("ToySeenHere-v0", other, observe=lacks)
    with pytest.raises(ValueError, match="it lacks the columns q1"):
        GymnasiumBatch("ToySeenHere-v0", TASK)


def test_refusals():
    with pytest.raises(ValueError, match="cannot be made: NameNotFound: Environment `NoSuch` .*PACKAGE:NoSuch-v0"):
        GymnasiumBatch("NoSuch-v0", TASK)
    with pytest.raises(ValueError, match="environment 'no_such:Reach-v0' cannot be made: "):
        GymnasiumBatch("no_such:Reach-v0", TASK)
    wide = Task(
        name="wide", observation_parts={"arm": 5}, actions={"a": Action("rad"), "b": Action("rad")}, position="arm"
    )
    with pytest.raises(
        ValueError, match=r"observation of environment 'ToyReach-v0' is Box\(.*\(4,\).*, task 'wide' has 5 columns"
    ):
        GymnasiumBatch("ToyReach-v0", wide)
    with pytest.raises(ValueError, match="'CartPole-v1' is Discrete.*, task 'arm' has 2 columns: .*TransformAction"):
        GymnasiumBatch("CartPole-v1", TASK)
    whole = gymnasium.spaces.Box(-9, 9, (2,), int)
    gymnasium.register("ToyWhole-v0", lambda: gymnasium.wrappers.TransformAction(Reach(), None, whole))
    with pytest.raises(ValueError, match="the action of environment 'ToyWhole-v0' is .*: wanted a flat Box of floats"):
        GymnasiumBatch("ToyWhole-v0", TASK)
    with pytest.raises(ValueError, match="info of environment 'ToyReach-v0' has no 'arrived', it has is_success"):
        GymnasiumBatch("ToyReach-v0", TASK, success_key="arrived")  # before any episode
    with pytest.raises(ValueError, match="cannot be made: .*unexpected keyword argument 'wide'"):
        GymnasiumBatch("ToyReach-v0", TASK, env_kwargs={"wide": 3})


def test_an_environment_that_cannot_be_made_is_named_with_any_error(monkeypatch):
    monkeypatch.setattr(registered(), "__init__", lambda env, key: env.robot)
    with pytest.raises(ValueError, match="^environment 'ToyReach-v0' cannot be made: AttributeError: 'Reach' object"):
        GymnasiumBatch("ToyReach-v0", TASK)


def test_a_success_key_may_come_with_the_end_of_an_episode(monkeypatch):
    step = registered().step

    def late(env, action):
        *others, truncated, _ = step(env, action)
        return *others, truncated, {"arrived": True, "time": 6.0} if truncated else {"power": 1.0}

    monkeypatch.setattr(registered(), "step", late)
    env = GymnasiumBatch("ToyReach-v0", TASK, success_key="arrived")
    assert env.success_key == "arrived" and run(env, 6)["success"].flatten().tolist() == [False] * 5 + [True]
    with pytest.raises(ValueError, match="info of env.* 'ToyReach-v0' has no 'won', it has arrived, power, time$"):
        GymnasiumBatch("ToyReach-v0", TASK, success_key="won")


def test_a_wrong_first_observation_is_refused(monkeypatch):
    reset = registered().reset
    monkeypatch.setattr(registered(), "reset", lambda env, **options: reset(env, **options)[0])
    with pytest.raises(ValueError, match=r"^environment 'ToyReach-v0': observation has shape \(\), wanted \(4,\)$"):
        GymnasiumBatch("ToyReach-v0", TASK)
    monkeypatch.setattr(registered(), "reset", lambda env, **options: (np.zeros(5), {}))
    with pytest.raises(ValueError, match=r"^environment 'ToyReach-v0': observation has shape \(5,\), wanted \(4,\)$"):
        GymnasiumBatch("ToyReach-v0", TASK)


def test_arguments_of_the_environment():
    env = GymnasiumBatch("ToyReach-v0", TASK, env_kwargs={"max_episode_steps": 2})
    assert env.own_limit == env.max_steps == 2 and env.success_key == "is_success"
    assert GymnasiumBatch("ToyReach-v0", TASK).own_limit is None
    assert GymnasiumBatch("ToyReachOwnKey-v0", TASK).success_key is None


def test_columns_of_a_dictionary_are_taken_by_name():
    """Goal and joints have one range: in the order of the dictionary they would be mistaken for each other."""
    parts = {name: gymnasium.spaces.Box(-9, 9, (2,), np.float64) for name in ("goal", "q")}
    space = gymnasium.spaces.Dict(parts | {"text": gymnasium.spaces.Text(9)})
    split = functools.partial(gymnasium.wrappers.TransformObservation, observation_space=space)
    with_parts = lambda: split(Reach(), lambda row: {"goal": row[2:], "q": row[:2], "text": "reach"})  # noqa: E731
    gymnasium.register("ToyParts-v0", with_parts, max_episode_steps=5)
    task = replace(TASK, observation_parts={"arm": ("q_0", "q_1", "goal_1")})
    seen = run(GymnasiumBatch("ToyParts-v0", task, 1), 3, [4])["observation"]
    plain = run(GymnasiumBatch("ToyReach-v0", TASK, 1), 3, [4])["observation"]
    assert torch.equal(seen, plain[..., [0, 1, 3]])
    with pytest.raises(
        ValueError, match="a dictionary of goal_0, goal_1, q_0, q_1; it lacks .*: convert .*state_names"
    ):
        GymnasiumBatch("ToyParts-v0", TASK)


def test_errors_and_clipped_actions_are_recorded_and_the_others_go_on():
    record = EpisodeRecord()
    env = GymnasiumBatch("ToyBreaks-v0", TASK, 3, record=record)
    env.seed_episodes([10, 11, 12])  # one with an odd seed cannot be reset
    env.reset()
    for push in (5.0, 0.1):
        action = torch.tensor([push, 0.1]).expand(3, 2)
        out = env.step(TensorDict({"action": action}, [3]))["next"]
    assert out["done"].flatten().tolist() == [False, True, False]
    assert record.errors == [{"seed": 11, "step": 1, "error": "reset: RuntimeError: no place"}]
    assert (record.actions, record.clipped) == (5, 3)
    assert record.faults() == [
        f"3 of 5 actions left the environment's box and were clipped to it (by column: {TASK.action_names[0]} 3)",
        "1 episodes failed by an error of the environment: seed 11, step 1: reset: RuntimeError: no place",
    ]


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        ([0, np.nan, 0, 0], "observation is NaN in column 1 (q2)"),
        ([0, 0, 0, -np.inf], "observation is infinite in column 3 (goal_2)"),
        ([0] * 5, "observation has shape (5,), wanted (4,)"),
    ],
)
@pytest.mark.parametrize("at", [0, 2])
def test_a_wrong_observation_fails_its_episode_and_the_others_go_on(seen, said, at, monkeypatch):
    observe = registered()._observe
    spoilt = lambda env: env.time == at and env.np_random_seed == 11  # noqa: E731
    monkeypatch.setattr(registered(), "_observe", lambda env: np.array(seen, float) if spoilt(env) else observe(env))
    record = EpisodeRecord()
    rollout = run(GymnasiumBatch("ToyReach-v0", TASK, 3, record=record), 6, [10, 11, 12])
    step = max(at, 1)  # an error of a reset is told with the first step
    assert record.errors == [{"seed": 11, "step": step, "error": f"{'reset: ' * (at == 0)}ObservationError: {said}"}]
    assert rollout["done"].sum(1).flatten().tolist() == [1, 7 - step, 1]
    assert rollout["failed"].any(1).flatten().tolist() == [False, True, False]
    assert rollout["success"].any(1).flatten().tolist() == [True, False, True]
    assert rollout["observation"].isfinite().all()


def test_a_reset_clears_the_outcome_of_the_last_episode(monkeypatch):
    observe = registered()._observe
    spoilt = lambda env: env.time == 2 and env.np_random_seed == 11  # noqa: E731
    monkeypatch.setattr(registered(), "_observe", lambda env: np.zeros(5) if spoilt(env) else observe(env))
    env = GymnasiumBatch("ToyReach-v0", TASK, 2)
    for _ in range(2):
        end = run(env, 6, [10, 11])[:, -1]
        assert end["success"].flatten().tolist() == [True, False] and end["failed"].flatten().tolist() == [False, True]
    start = env.reset()
    assert not any(start[name].any() for name in ("success", "failed", "done", "truncated"))
    assert [(error["seed"], error["step"]) for error in env.record.errors] == [(11, 2)] * 2


def test_a_picture_s_environment_names_the_entry_that_is_wrong():
    env = Seen()
    episode = GymnasiumEpisode(env, 0, max_steps=9)
    episode.reset(seed=0)
    good, wrong = env._give(), iter(({"agent_pos": np.array([1.0, np.nan])}, {"agent_pos": np.zeros(3)}))
    env._give = lambda: good | next(wrong)
    assert episode.step(ACTION)[-1]["error"] == "ObservationError: observation is NaN in column 1 (agent_pos)"
    env._give = lambda: good
    episode.reset(seed=0)
    env._give = lambda: good | next(wrong)
    said = "ObservationError: observation 'agent_pos' has shape (3,), wanted (2,)"
    assert episode.step(ACTION)[-1]["error"] == said


ACTION = np.full(2, PUSH, dtype=np.float32)


def played(env, steps, seed=0):
    env.reset(seed=seed)
    return [env.step(ACTION) for _ in range(steps)]


def test_rounding_of_float32_is_no_clipping():
    env = Reach()
    env.action_space = gymnasium.spaces.Box(-0.1, 0.1, (2,), np.float64)
    env = GymnasiumEpisode(env, 0, max_steps=9)
    env.reset(seed=0)
    assert float(ACTION[0]) > 0.1 and not env.step(ACTION)[-1]["clipped"].any()
    assert env.step(1.001 * ACTION)[-1]["clipped"].all()


def test_an_error_in_a_step_ends_the_episode():
    told = [step[-1] for step in played(GymnasiumEpisode(Breaks(at=2), 0, max_steps=9), 3)]
    assert [each["error"] for each in told] == ["", "ZeroDivisionError: division by zero", ""]
    assert [each["played"] for each in told] == [True, True, False] and not told[-1]["success"]
    assert told[1]["truncated"] and not told[1]["terminated"]


@pytest.mark.parametrize(("said", "wanted"), [("False", False), ("true", True), (np.array([True]), True), (0, False)])
def test_success_may_be_said_in_words(said, wanted):
    env = GymnasiumEpisode(Reach(), 0, max_steps=9)
    assert env._succeeded({"is_success": said}, 0.0, False) is wanted


def test_a_final_reward_means_success_above_twice_any_earlier_one():
    class Rewards(Reach):
        def step(self, action):
            seen, _, _, _, _ = super().step(action)
            reward = rewards.pop(0)
            return seen, reward, not rewards, False, {}

    for given, wanted in (([1.0, 0.1, 2.0], False), ([1.0, 0.1, 2.1], True), ([-1.0, 0.0], False), ([0.1], True)):
        rewards = list(given)
        assert played(GymnasiumEpisode(Rewards(), 0, max_steps=9), len(given))[-1][-1]["success"] is wanted, given
    asked = GymnasiumEpisode(Reach(), 0, max_steps=9, success_key="arrived")
    assert not asked._succeeded({}, 2.0, True)  # a requested key is not replaced by a reward
