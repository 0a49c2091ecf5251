# This source code is licensed under the MIT license found in the LICENSE file.
"""Gymnasium environments of a two-joint robot that report success in different ways."""

import gymnasium
import numpy as np
from torchrl.envs import DoubleToFloat, EnvBase, GymEnv, SerialEnv, TransformedEnv

NAMES = ("q1", "q2", "goal_1", "goal_2")


class Reach(gymnasium.Env):
    """Joints follow delta commands with a lag; an episode starts at random and lasts ``length`` steps.

    The task succeeds in step ``count`` of every episode, whatever the robot does.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, key=None, count=3, length=6, terminates=False):
        self.key, self.count, self.length, self.terminates = key, count, length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.joints, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        self.speed, self.time = np.zeros(2), 0
        return self._observe(), {}

    def step(self, action):
        self.speed = 0.6 * self.speed + 0.4 * np.asarray(action, dtype=np.float64)
        self.joints = self.joints + self.speed
        self.time += 1
        now = self.time == self.count
        info = {} if self.key is None else {self.key: now}
        terminated = self.terminates and self.time >= self.count
        won = now and self.terminates == "won"
        reward = 1.0 if won or self.terminates == "fell" else 0.0
        return self._observe(), reward, bool(terminated), self.time >= self.length, info

    def _observe(self):
        return np.concatenate([self.joints, self.goal])


class Breaks(Reach):
    def __init__(self, at=None, **options):
        super().__init__(key="is_success", **options)
        self.at = at

    def reset(self, *, seed=None, options=None):
        if self.at is None and seed % 2:
            raise RuntimeError("no\nplace")
        return super().reset(seed=seed)

    def step(self, action):
        if self.time + 1 == self.at:
            raise ZeroDivisionError("division by zero")
        return super().step(action)


class Drawn(Reach):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, shade=0, render_mode=None):
        super().__init__(key="is_success")
        self.shade, self.render_mode = shade, render_mode

    def render(self):
        picture = np.full((8, 8, 3), self.shade, np.uint8)
        picture[..., 0] = int(100 + 50 * self.joints[0])
        return picture


for _id, _options in {
    "ToyReach-v0": {"key": "is_success"},
    "ToyReachOwnKey-v0": {"key": "arrived"},
    "ToyReachWon-v0": {"terminates": "won"},
    "ToyReachLost-v0": {"terminates": "lost"},
    "ToyReachFell-v0": {"terminates": "fell"},  # a reward in every step, as for walking robots
}.items():
    gymnasium.register(_id, entry_point=Reach, kwargs=_options)
gymnasium.register("ToyLimited-v0", Reach, max_episode_steps=5)
gymnasium.register("ToyBreaks-v0", Breaks)
gymnasium.register("ToyDrawn-v0", Drawn)


def reach(robots: int | None = None, **options) -> EnvBase:
    """Returns the robot as a TorchRL environment in float32; a batch of ``robots`` if given."""

    def one():
        return TransformedEnv(GymEnv("ToyReach-v0", **options), DoubleToFloat(in_keys=["observation"]))

    return one() if robots is None else SerialEnv(robots, one)


class Seen(gymnasium.Env):
    def __init__(self, cameras=("top",)):
        box, picture = gymnasium.spaces.Box(-9, 9, (2,)), gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
        pixels = dict.fromkeys(cameras, picture) if len(cameras) > 1 else picture
        pixels = gymnasium.spaces.Dict(pixels) if len(cameras) > 1 else pixels
        self.observation_space = gymnasium.spaces.Dict({"agent_pos": box, "pixels": pixels})
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def _give(self):
        pixels = self.observation_space["pixels"]
        several = isinstance(pixels, gymnasium.spaces.Dict)
        frames = {name: np.full((8, 8, 3), len(name), np.uint8) for name in (pixels if several else ["top"])}
        return {"agent_pos": np.array([1.0, 2.0]), "pixels": frames if several else frames["top"]}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._give(), {}

    def step(self, action):
        return self._give(), 0.0, False, False, {}


gymnasium.register("ToySeen-v0", Seen, max_episode_steps=5)
