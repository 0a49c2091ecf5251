# This source code is licensed under the MIT license found in the LICENSE file.
"""Meta-World: seven tasks of an arm with a gripper, 100 demonstrations each by its own scripted policies.

Meta-World pins another version of MuJoCo. A folder that comes first on PYTHONPATH provides it and leaves the installed
one unchanged. States are the present frame and the goal, without the previous frame. Success ends an episode.
"""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from proving_grounds.ground import Ground

from torchrl_koap.data import save_demonstrations

TASKS = (
    "assembly",
    "button-press",
    "bin-picking",
    "peg-insert-side",
    "shelf-place",
    "drawer-open",
    "pick-place",
)
STEPS, DEMONSTRATIONS = 500, 100
HAND = ["hand_x", "hand_y", "hand_z", "fingers"]
STATE = [*HAND, *(f"object_{axis}" for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")), "goal_x", "goal_y", "goal_z"]
SEEN = [*range(11), 36, 37, 38]  # of the simulator's 39 columns
INSTALL = "pip install --no-deps --target FOLDER metaworld==3.0.0 mujoco==3.3.0, then run with PYTHONPATH=FOLDER"


class PresentFrame(gymnasium.Wrapper):
    """One task with the columns of the present frame; the seed determines the positions of objects and goal."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        env.unwrapped.seeded_rand_vec, env.unwrapped._freeze_rand_vec = True, False
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(SEEN),), np.float32)
        self.whole = np.zeros(39)  # observation that the scripted policy reads

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begins an episode."""
        if seed is not None:
            self.unwrapped.seed(seed)
        self.whole, info = self.env.reset(seed=seed)
        return self.whole[SEEN].astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Makes a control step; success ends the episode."""
        self.whole, reward, over, truncated, info = self.env.step(action)
        return self.whole[SEEN].astype(np.float32), float(reward), bool(over or info["success"]), truncated, info


def make_env(task: str, **options: Any) -> gymnasium.Env:
    """Makes the simulator of a task, such as ``"assembly"``."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    return PresentFrame(ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"](seed=0, **options))


def record(task: str, count: int = DEMONSTRATIONS) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Records the first ``count`` successes of the scripted policy: frames ``[T + 1, 14]`` and actions ``[T, 4]``."""
    from metaworld.policies import ENV_POLICY_MAP

    env, policy, states, actions = make_env(task), ENV_POLICY_MAP[f"{task}-v3"](), [], []
    for seed in range(2 * count):
        frames, taken, info = [env.reset(seed=seed)[0]], [], {"success": False}
        while len(taken) < STEPS - 1 and not info["success"]:
            with warnings.catch_warnings():  # the policy warns that its actions exceed the executed range
                warnings.simplefilter("ignore")
                taken.append(np.clip(policy.get_action(env.whole), -1, 1).astype(np.float32))
            frame, *_, info = env.step(taken[-1])
            frames.append(frame)
        if info["success"] and len(states) < count:
            states.append(np.stack(frames))
            actions.append(np.stack(taken))
    return states, actions


def write(task: str, folder: Path) -> None:
    """Writes the demonstrations as a data set."""
    save_demonstrations(
        folder,
        *record(task),
        control_hz=80,
        state_names=STATE,
        action_names=["move_x", "move_y", "move_z", "close"],
        robot=HAND,
        action_kind=["delta", "delta", "delta", "raw"],
        max_steps=STEPS,
    )


GROUNDS = {}
for name in TASKS:
    env_id = f"torchrl_koap/MetaWorld-{name}-v0"
    gymnasium.register(env_id, partial(make_env, name), max_episode_steps=STEPS, disable_env_checker=True)
    GROUNDS[f"meta_world_{name}"] = Ground(
        partial(write, name), "success", (5,), 100, env_id, STEPS, package="metaworld", install=INSTALL
    )
