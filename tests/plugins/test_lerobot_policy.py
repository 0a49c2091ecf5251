# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the exported folder with LeRobot's own functions, in an environment that has LeRobot."""

import json

import gymnasium
import numpy as np
import pytest
import torch
from camera_sets import write_filmed
from tiny_runs import TINY, koap

from torchrl_koap import Agent, load_policy
from torchrl_koap.data import read_recordings
from torchrl_koap.modules.execution.policy_env import NoiseStreams
from torchrl_koap.runs.weights import CheckpointError

INSTALL = "is not installed: pip install ./integrations/lerobot_policy_koap (docs/howto/lerobot.md)"
pytest.importorskip("lerobot", reason=f"lerobot {INSTALL}")
pytest.importorskip("lerobot_policy_koap", reason=f"lerobot_policy_koap {INSTALL}")

from lerobot.configs.policies import PreTrainedConfig  # noqa: E402
from lerobot.configs.types import FeatureType, PolicyFeature  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.envs.configs import PushtEnv  # noqa: E402
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors  # noqa: E402
from lerobot.processor import PolicyProcessorPipeline  # noqa: E402
from lerobot.scripts.lerobot_eval import rollout  # noqa: E402
from lerobot.utils.control_utils import predict_action  # noqa: E402
from lerobot_policy_koap.modeling_koap import KoapPolicy  # noqa: E402
from lerobot_policy_koap.processor_koap import make_koap_pre_post_processors  # noqa: E402

ENV = PushtEnv(obs_type="environment_state_agent_pos")
NAMES = ("x", "y", *(f"environment_state_{index}" for index in range(16)))


def write_data(folder):
    folder.mkdir()
    random = np.random.default_rng(0)
    for number in range(4):
        states = random.normal(size=(40, 18)).cumsum(0)
        moves = np.diff(states[:, :2], axis=0)
        named = {"state_names": NAMES, "action_names": ("vx", "vy")}
        np.savez(folder / f"{number}.npz", states=states, actions=moves, control_hz=10.0, **named)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    write_data(folder / "raw")
    assert koap("convert", folder / "raw", "--out", folder / "own", "--robot", "x", "y", "--quiet") == 0
    assert koap("train", "--dataset", folder / "own", "--out", folder / "run", *TINY, "--quiet") == 0
    return folder / "run"


@pytest.fixture
def exported(run, tmp_path):
    assert koap("export", run, "--format", "lerobot", "--out", tmp_path / "exported", "--quiet") == 0
    return tmp_path / "exported"


def loaded(folder, *overrides, **where):
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=list(overrides))
    config.pretrained_path = folder
    policy = make_policy(config, **(where or {"env_cfg": ENV}))
    changes = {"rename_observations_processor": {"rename_map": {}}, "device_processor": {"device": "cpu"}}
    return policy, *make_pre_post_processors(config, str(folder), preprocessor_overrides=changes)


def acted(run, observations, seed=0):
    agent = Agent(load_policy(run), seed=seed)
    agent.reset()
    return np.stack([agent.act(each) for each in observations])


class Points(gymnasium.Env):
    """A point that goes where it is told, in the entries of LeRobot's Push-T."""

    metadata = {"render_modes": []}
    task = task_description = ""
    _max_episode_steps = 12
    observation_space = gymnasium.spaces.Dict(
        {
            "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64),
            "environment_state": gymnasium.spaces.Box(-np.inf, np.inf, (16,), np.float64),
        }
    )
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.left = self.np_random.normal(size=2), self._max_episode_steps
        return self.seen(), {}

    def seen(self):
        return {"agent_pos": self.at.copy(), "environment_state": np.tile(self.at, 8)}

    def step(self, action):
        self.at, self.left = self.at + action, self.left - 1
        return self.seen(), 0.0, False, self.left == 0, {"is_success": False}


def test_a_batch_of_environments_is_acted_in_as_by_an_agent(run, exported):
    policy, before, after = loaded(exported, "--seed=5")
    none = PolicyProcessorPipeline(steps=[])
    env = gymnasium.vector.SyncVectorEnv([Points] * 3)
    seen = rollout(env, policy, none, none, before, after, seeds=[1, 2, 3], return_observations=True)
    assert seen["action"].shape == (3, 12, 2)
    given = torch.cat([seen["observation"][f"observation.{name}"] for name in ("state", "environment_state")], -1)
    np.testing.assert_array_equal(seen["action"].movedim(1, 0), acted(run, given.movedim(1, 0)[:12].numpy(), seed=5))


def test_actions_for_recorded_observations_as_lerobot_record_asks(run, exported):
    states = np.load(run.parent / "raw" / "0.npz")["states"].astype(np.float32)
    policy, before, after = loaded(exported)
    policy.reset()
    actions = [
        predict_action(
            {"observation.state": row[:2], "observation.environment_state": row[2:]},
            policy,
            torch.device("cpu"),
            before,
            after,
            use_amp=False,
        )[0].numpy()
        for row in states
    ]
    np.testing.assert_allclose(actions, acted(run, states), rtol=1e-5, atol=1e-6)


def test_a_chunk_begins_with_the_first_action_of_an_episode(run, exported):
    policy, *_ = loaded(exported)
    batch = {"observation.state": torch.ones(3, 2), "observation.environment_state": torch.ones(3, 16)}
    streams = NoiseStreams(range(3), policy.policy.noise_shape, block=policy.policy.max_steps)
    chunk = policy.predict_action_chunk(batch, noise=streams.draw())
    assert chunk.shape == (3, policy.policy.execution.replan_interval, 2)
    torch.testing.assert_close(chunk[:, 0], policy.select_action(batch))
    assert not torch.equal(policy.predict_action_chunk(batch), policy.predict_action_chunk(batch))


def test_what_is_saved_is_what_was_exported(exported, tmp_path):
    policy, *_ = loaded(exported)
    policy.save_pretrained(tmp_path / "saved")
    for name, pipeline in zip(("pre", "post"), make_koap_pre_post_processors(policy.config), strict=True):
        pipeline.save_pretrained(tmp_path / "made")
        made, given = (
            json.loads((tmp_path / where / f"policy_{name}processor.json").read_text()) for where in ("made", "saved")
        )
        assert made == given == json.loads((exported / f"policy_{name}processor.json").read_text())
    again = KoapPolicy.from_pretrained(tmp_path / "saved")
    assert again.config.input_features == policy.config.input_features and not again.training
    assert all(map(torch.equal, again.state_dict().values(), policy.state_dict().values()))


def test_frames_come_as_lerobot_scales_them(tmp_path):
    write_filmed(tmp_path / "raw", cameras=("image",), length=40)
    embed = ("--network", "tiny_network:random_layer", "--components", "5", "--quiet")
    assert koap("convert", tmp_path / "raw", "--out", tmp_path / "own", "--quiet") == 0
    assert koap("embed", tmp_path / "own", "--camera", "image", "--out", tmp_path / "seen", *embed) == 0
    assert koap("train", "--dataset", tmp_path / "seen", "--out", tmp_path / "run", *TINY, "--quiet") == 0
    assert koap("export", tmp_path / "run", "--format", "lerobot", "--out", tmp_path / "out", "--quiet") == 0
    with pytest.raises(CheckpointError, match="embeds frames with code of tiny_network: name it in plugins"):
        loaded(tmp_path / "out", env_cfg=PushtEnv())
    policy, before, _ = loaded(tmp_path / "out", '--plugins=["tiny_network"]', env_cfg=PushtEnv())
    frames, state = np.load(tmp_path / "raw" / "00" / "image.npy")[:2], np.ones((2, 2), np.float32)
    batch = {"observation.state": state, "observation.image": frames.transpose(0, 3, 1, 2).astype(np.float32) / 255}
    batch = {name: torch.from_numpy(value) for name, value in batch.items()}
    (wanted,) = acted(tmp_path / "run", [{"state": state, "image": frames}])
    np.testing.assert_array_equal(policy.select_action(before(batch)), wanted)
    with pytest.raises(
        ValueError, match=r"no observation.image: the policy takes observation.state, observation.image"
    ):
        policy.select_action(
            before({"observation.state": torch.ones(2, 2), "observation.images.top": batch["observation.image"]})
        )


def test_features_that_are_not_those_of_the_run_are_named(exported):
    policy, *_ = loaded(exported)
    given = {"observation.state": torch.ones(1, 2), "observation.environment_state": torch.ones(1, 15)}
    with pytest.raises(ValueError, match="observation.environment_state has 15 columns, the policy has 16"):
        policy.select_action(given)
    del given["observation.environment_state"]
    with pytest.raises(ValueError, match="has no observation.environment_state: .* got observation.state; see --env"):
        policy.select_action(given)
    three = PushtEnv(features={"action": PolicyFeature(FeatureType.ACTION, (3,))})
    with pytest.raises(ValueError, match="action has 3 columns, the policy has 2: vx, vy"):
        loaded(exported, env_cfg=three)


def test_training_is_refused(exported):
    policy, *_ = loaded(exported)
    for asked in (lambda: policy({}), policy.get_optim_params, policy.config.get_optimizer_preset):
        with pytest.raises(NotImplementedError, match="train with `koap train`, write the folder with `koap export"):
            asked()
    with pytest.raises(ValueError, match="there are no weights. LeRobot does not train koap policies"):
        make_policy(make_policy_config("koap", device="cpu"), env_cfg=ENV)


def robot_set(root, state=("x", "y"), fps=10):
    surroundings = {"dtype": "float32", "shape": (16,), "names": [f"point_{index}" for index in range(16)]}
    features = {
        "observation.state": {"dtype": "float32", "shape": (len(state),), "names": list(state)},
        "observation.environment_state": surroundings,
        "action": {"dtype": "float32", "shape": (2,), "names": ["vx", "vy"]},
    }
    return LeRobotDataset.create("koap/eval_arm", fps=fps, features=features, root=root, use_videos=False)


def test_the_columns_of_a_robot_are_compared(exported, tmp_path):
    loaded(exported, ds_meta=robot_set(tmp_path / "same").meta)
    with pytest.raises(ValueError, match="observation.state is y, x; the policy has another order: x, y"):
        loaded(exported, ds_meta=robot_set(tmp_path / "turned", ("y", "x")).meta)
    with pytest.raises(ValueError, match="observation.state has 3 columns, the policy has 2: x, y"):
        loaded(exported, ds_meta=robot_set(tmp_path / "more", ("x", "y", "z")).meta)
    with pytest.warns(UserWarning, match="control_hz is 30, the policy was trained on data of 10 Hz"):
        loaded(exported, ds_meta=robot_set(tmp_path / "fast", fps=30).meta)


def test_what_lerobot_writes_is_read_without_loss(tmp_path):
    written, random, kept = robot_set(tmp_path / "set"), np.random.default_rng(0), []
    for length in (7, 9):
        kept.append([random.normal(size=(length, width)).astype(np.float32) for width in (2, 16, 2)])
        for state, points, action in zip(*kept[-1], strict=True):
            frame = {"observation.state": state, "observation.environment_state": points, "action": action}
            written.add_frame(frame | {"task": f"push for {length} steps"})
        written.save_episode()
    written.finalize()
    found = read_recordings(tmp_path / "set")
    assert found.control_hz == 10
    assert found.skipped == ("task_index (2 tasks become one: name the episodes (--episodes) of one)", "timestamp")
    assert found.state_names == ("x", "y", *(f"environment_state_point_{index}" for index in range(16)))
    for (state, points, action), frames, steps in zip(kept, found.states, found.actions, strict=True):
        np.testing.assert_array_equal(frames, np.concatenate([state, points], 1))
        np.testing.assert_array_equal(steps, action[:-1])
