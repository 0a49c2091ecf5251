# This source code is licensed under the MIT license found in the LICENSE file.
"""Push-T: 206 human demonstrations (Chi et al. 2023, MIT licence) and the simulator gym-pusht 0.1.8.

The simulator is no dependency of the package: ``pip install gym-pusht==0.1.8 "pymunk<7"``.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np

from torchrl_koap.data import save_demonstrations

DATA = Path(__file__).resolve().parents[2] / "shared" / "proving_grounds" / "pusht_human_206.npz"
ENV = "torchrl_koap/PushT-v0"
STEPS, FIRST_SEED = 300, 100_000
COLUMNS = {"agent_x": "px", "agent_y": "px", "block_x": "px", "block_y": "px", "block_cos": "", "block_sin": ""}


def columns(state: np.ndarray) -> np.ndarray:
    """States ``[*B, 5]`` (agent x, y, block x, y in px, angle in rad) to ``[*B, 6]``, the angle as cosine and sine."""
    angle = state[..., 4:]
    return np.concatenate([state[..., :4], np.cos(angle), np.sin(angle)], -1).astype(np.float32)


def write_data_set(folder: Path) -> None:
    """Writes the demonstrations, all of them with their actions, as a data set of ``koap train``."""
    if not DATA.is_file():
        raise FileNotFoundError(f"{DATA} is not there: it holds the human demonstrations of Push-T")
    raw = np.load(DATA)
    ends = raw["episode_ends"][:-1]
    save_demonstrations(
        folder,
        np.split(columns(raw["state"]), ends),
        np.split(raw["action"].astype(np.float32), ends),
        control_hz=10,
        state_names=list(COLUMNS),
        state_units=list(COLUMNS.values()),
        action_names=["target_x", "target_y"],
        action_units="px",
        robot=["agent_x", "agent_y"],
        action_kind="absolute",
        targets=["agent_x", "agent_y"],
        max_steps=STEPS,
    )


class SixColumns(gymnasium.ObservationWrapper):
    """Observations as :func:`columns` makes them."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(COLUMNS),), np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """One state."""
        return columns(np.asarray(observation))


def make_env(**options: object) -> gymnasium.Env:
    """Makes the simulator, which states as they are recorded come out of."""
    import gym_pusht  # noqa: F401  # registers it

    return SixColumns(gymnasium.make("gym_pusht/PushT-v0", obs_type="state", disable_env_checker=True, **options))


gymnasium.register(ENV, make_env, max_episode_steps=STEPS, disable_env_checker=True)
