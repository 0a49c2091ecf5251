# This source code is licensed under the MIT license found in the LICENSE file.
"""Push-T: a disc pushes a T-shaped block to a target; 206 human demonstrations of Chi et al. 2023 (MIT licence).

One ground has states, the other the agent's position and frames of 96 x 96 pixels. The simulator renders the frames of
recorded states; they need the extra ``vision``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from proving_grounds.ground import SHARED, Ground

from torchrl_koap.data import read_recordings, save_demonstrations
from torchrl_koap.vision.embedding import embed_recordings, read_sources

DATA = SHARED / "pusht_human_206.npz"
ENV, PIXELS = "torchrl_koap/PushT-v0", "torchrl_koap/PushTPixels-v0"
STEPS = 300
AGENT, TARGET = ("agent_x", "agent_y"), ("target_x", "target_y")
ABSOLUTE: dict[str, Any] = {"action_kind": "absolute", "targets": AGENT, "action_units": "px", "max_steps": STEPS}
STATE = {"agent_x": "px", "agent_y": "px", "block_x": "px", "block_y": "px", "block_cos": "", "block_sin": ""}


def six_columns(state: np.ndarray) -> np.ndarray:
    """Converts states ``[*B, 5]`` (agent x, y, block x, y in px, angle in rad) to ``[*B, 6]`` with cosine and sine."""
    angle = state[..., 4:]
    return np.concatenate([state[..., :4], np.cos(angle), np.sin(angle)], -1).astype(np.float32)


def read_episodes() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Reads the states ``[T, 5]`` and the actions ``[T, 2]`` of every demonstration."""
    raw = np.load(DATA)
    ends = raw["episode_ends"][:-1]
    return np.split(raw["state"], ends), np.split(raw["action"].astype(np.float32), ends)


def write_data_set(folder: Path, *, demonstrations: int | None = None) -> None:
    """Writes all or the first ``demonstrations``, with their actions, as a data set of ``koap train``."""
    states, actions = (each[:demonstrations] for each in read_episodes())
    save_demonstrations(
        folder,
        list(map(six_columns, states)),
        actions,
        control_hz=10,
        state_names=list(STATE),
        state_units=list(STATE.values()),
        action_names=TARGET,
        robot=list(AGENT),
        **ABSOLUTE,
    )


def write_pixels(folder: Path) -> None:
    """Writes the demonstrations with embeddings of frames in place of the block's columns."""
    env, raw, own = make_pixels().unwrapped, folder / "raw", folder / "own"
    env.reset(seed=0)
    for number, (states, actions) in enumerate(zip(*read_episodes(), strict=True)):
        (raw / f"{number:03d}").mkdir(parents=True)
        np.save(raw / f"{number:03d}" / "top.npy", np.stack([draw(env, state) for state in states]))
        agent = states[:, :2].astype(np.float32)
        np.savez(
            raw / f"{number:03d}.npz",
            states=agent,
            state_names=AGENT,
            actions=actions,
            action_names=TARGET,
            control_hz=10.0,
        )
    save_demonstrations(own, read_recordings(raw), state_units="px", **ABSOLUTE)
    print(embed_recordings(*read_sources([own], None), folder)["top"])


def draw(env: Any, state: np.ndarray) -> np.ndarray:
    """Renders a state ``[5]`` as the environment does, contact marks included, uint8 ``[96, 96, 3]``."""
    place(env, state)
    env.space.step(1e-9)  # a step computes the contacts; it is short, so that nothing moves
    place(env, state)
    return env.get_obs()["pixels"]


def place(env: Any, state: np.ndarray) -> None:
    """Puts agent and block at the positions of a state ``[5]``, at rest."""
    env.block.angle = float(state[4])  # before the position, which depends on it
    env.block.position, env.agent.position = tuple(map(float, state[2:4])), tuple(map(float, state[:2]))
    for body in (env.agent, env.block):
        body.velocity, body.angular_velocity = (0, 0), 0
        env.space.reindex_shapes_for_body(body)


class SixColumns(gymnasium.ObservationWrapper):
    """Converts observations by :func:`six_columns`."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(STATE),), np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Converts one state."""
        return six_columns(np.asarray(observation))


def make_env(**options: object) -> gymnasium.Env:
    """Makes the simulator with observations like the recorded states."""
    import gym_pusht  # noqa: F401  # registers it

    return SixColumns(gymnasium.make("gym_pusht/PushT-v0", obs_type="state", disable_env_checker=True, **options))


def make_pixels(**options: object) -> gymnasium.Env:
    """Makes the simulator with observations of pictures and the agent's position."""
    import gym_pusht  # noqa: F401  # registers it

    options |= {"obs_type": "pixels_agent_pos", "observation_width": 96, "observation_height": 96}
    return gymnasium.make("gym_pusht/PushT-v0", disable_env_checker=True, **options)


gymnasium.register(ENV, make_env, max_episode_steps=STEPS, disable_env_checker=True)
gymnasium.register(PIXELS, make_pixels, max_episode_steps=STEPS, disable_env_checker=True)
INSTALL = 'pip install gym-pusht==0.1.8 "pymunk<7"'
GROUNDS = {
    "pusht": Ground(write_data_set, "reward", (10,), 150, ENV, STEPS, DATA, "gym_pusht", INSTALL),
    "pusht_pixels": Ground(write_pixels, "reward", (10,), 150, PIXELS, STEPS, DATA, "gym_pusht", INSTALL),
}
