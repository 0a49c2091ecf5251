# This source code is licensed under the MIT license found in the LICENSE file.
"""Adroit door: a hand of 28 actuators unlatches and opens a door; 25 human demonstrations with a data glove.

The demonstrations are those of Rajeswaran et al. 2018 (Apache-2.0). Actions are normalised targets of the actuators.
No column holds the hand's first joint; the position of the palm reflects it. All demonstrations open the door by 1 rad.
7 of 25 reach 1.35 rad, the simulator's success, 8 when their actions are replayed. Each angle is a separate ground.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from proving_grounds.ground import SHARED, Ground

from torchrl_koap.data import save_demonstrations

DATA = SHARED / "adroit_door_human_25.npz"
STEPS = 300
COUNTED = {"adroit_door": 1.35, "adroit_door_1_rad": 1.0}  # opening of the door that counts as success (rad)
JOINTS, PALM = [f"joint_{number}" for number in range(1, 28)], ["palm_x", "palm_y", "palm_z"]
DOOR = ["latch", "hinge"]
HANDLE = ["handle_x", "handle_y", "handle_z", "to_palm_x", "to_palm_y", "to_palm_z", "is_open"]
STATE = [*JOINTS, *DOOR, *PALM, *HANDLE]
HINGE = STATE.index("hinge")


def split(values: np.ndarray, ends: np.ndarray) -> list[np.ndarray]:
    """Splits steps ``[N, d]`` into episodes."""
    return np.split(values, ends[:-1])


def write(folder: Path) -> None:
    """Writes the demonstrations as a data set; actions are clipped to the range that the simulator executes."""
    raw = np.load(DATA)
    save_demonstrations(
        folder,
        split(raw["observations"], raw["episode_ends"]),
        split(raw["actions"].clip(-1, 1), raw["episode_ends"]),
        control_hz=100,
        state_names=STATE,
        action_names=[f"actuator_{number}" for number in range(28)],
        robot=[*JOINTS, *PALM],
        action_kind="raw",
        max_steps=STEPS,
    )


class Opened(gymnasium.Wrapper):
    """Reports success when the door is open by an angle (rad)."""

    def __init__(self, env: gymnasium.Env, angle: float):
        super().__init__(env)
        self.angle = angle

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Makes a control step; adds ``success`` to the info."""
        observation, reward, over, truncated, info = self.env.step(action)
        return observation, reward, over, truncated, info | {"success": bool(observation[HINGE] >= self.angle)}


def make_env(angle: float = COUNTED["adroit_door"], **options: Any) -> gymnasium.Env:
    """Makes the simulator."""
    import gymnasium_robotics  # noqa: F401  # registers it

    env = gymnasium.make("AdroitHandDoor-v1", max_episode_steps=STEPS, disable_env_checker=True, **options)
    return Opened(env, angle)


def replay() -> list[bool]:
    """Replays the recorded actions from the recorded starts; returns for each episode whether the door opens."""
    raw, env, opened = np.load(DATA), make_env(), []
    for number, actions in enumerate(split(raw["actions"], raw["episode_ends"])):
        env.reset(seed=0)
        start = {"qpos": raw["initial_qpos"][number], "qvel": raw["initial_qvel"][number]}
        env.unwrapped.set_env_state(start | {"door_body_pos": raw["door_body_position"][number]})
        opened.append(any(bool(env.step(action)[4]["success"]) for action in actions))
    return opened


GROUNDS = {}
for name, angle in COUNTED.items():
    env_id = f"torchrl_koap/{name}-v0"
    gymnasium.register(env_id, partial(make_env, angle), max_episode_steps=STEPS, disable_env_checker=True)
    GROUNDS[name] = Ground(
        write,
        "success",
        (5, 25),
        100,
        env=env_id,
        max_steps=STEPS,
        data=DATA,
        package="gymnasium_robotics",
        install="pip install --no-deps gymnasium-robotics==1.4.2",
        runs_of="adroit_door",
    )
