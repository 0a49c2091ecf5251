# This source code is licensed under the MIT license found in the LICENSE file.
"""Push-T, demonstrations and simulator of others: the default command of each method, without any tuning.

    python benchmarks/proving_grounds.py --labels 10 --seeds 3
    python benchmarks/proving_grounds.py --ground pusht_pixels --methods koap

The 206 human demonstrations are those of Chi et al. 2023 (MIT licence). The simulator is no dependency of the package:
``pip install gym-pusht==0.1.8 "pymunk<7"``.

The second call sees the agent's place and frames of 96 x 96, which the simulator draws of the recorded states; it needs
the extra ``vision``.

Trains and rolls out every method with every training seed, and appends rows to
``benchmarks/results/proving_grounds.csv``. What is there already is not run again. The planner is that of the first
method. Seconds are those of one core, with the time to read the demonstrations.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
import tyro
from tables import open_table

from torchrl_koap import LabelConfig, PlannerConfig, RunConfig, TrainConfig, Trained, load_policy, train
from torchrl_koap.data import read_recordings, save_demonstrations
from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.training.methods import METHODS, get_method
from torchrl_koap.vision.embedding import embed_recordings, read_sources
from torchrl_koap.vision.observer import Observer

RESULTS = Path(__file__).resolve().parent / "results" / "proving_grounds.csv"
DATA = Path(__file__).resolve().parents[2] / "shared" / "proving_grounds" / "pusht_human_206.npz"
ENV, PIXELS = "torchrl_koap/PushT-v0", "torchrl_koap/PushTPixels-v0"
Ground = Literal["pusht", "pusht_pixels"]
STEPS, FIRST_SEED = 300, 100_000
AGENT, TARGET = ("agent_x", "agent_y"), ("target_x", "target_y")
ABSOLUTE: dict[str, Any] = {"action_kind": "absolute", "targets": AGENT, "action_units": "px", "max_steps": STEPS}
STATE = {"agent_x": "px", "agent_y": "px", "block_x": "px", "block_y": "px", "block_cos": "", "block_sin": ""}
KEYS = ("ground", "method", "labels", "seed", "execution", "n")
COLUMNS = (
    *KEYS,
    "largest_reward",
    "standard_error",
    "successes",
    "held_out_score",
    "kept_update",
    "train_core_seconds",
)


def six_columns(state: np.ndarray) -> np.ndarray:
    """States ``[*B, 5]`` (agent x, y, block x, y in px, angle in rad) to ``[*B, 6]``, the angle as cosine and sine."""
    angle = state[..., 4:]
    return np.concatenate([state[..., :4], np.cos(angle), np.sin(angle)], -1).astype(np.float32)


def read_episodes() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Reads the states ``[T, 5]`` and the actions ``[T, 2]`` of every demonstration."""
    if not DATA.is_file():
        raise FileNotFoundError(f"{DATA} is not there: it holds the human demonstrations of Push-T")
    raw = np.load(DATA)
    ends = raw["episode_ends"][:-1]
    return np.split(raw["state"], ends), np.split(raw["action"].astype(np.float32), ends)


def write_data_set(folder: Path) -> None:
    """Writes the demonstrations, all of them with their actions, as a data set of ``koap train``."""
    states, actions = read_episodes()
    save_demonstrations(
        folder,
        [six_columns(state) for state in states],
        actions,
        control_hz=10,
        state_names=list(STATE),
        state_units=list(STATE.values()),
        action_names=TARGET,
        robot=list(AGENT),
        **ABSOLUTE,
    )


def write_pixels(folder: Path) -> None:
    """Writes the same with the embeddings of frames in place of the block's columns."""
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
    """Draws a state ``[5]`` as the environment sees it, marks of contacts included, uint8 ``[96, 96, 3]``."""
    for step in (1e-9, None):  # contacts are found in a step, which must not move anything
        env.block.angle = float(state[4])  # before the position, which depends on it
        env.block.position, env.agent.position = tuple(map(float, state[2:4])), tuple(map(float, state[:2]))
        for body in (env.agent, env.block):
            body.velocity, body.angular_velocity = (0, 0), 0
            env.space.reindex_shapes_for_body(body)
        if step is not None:
            env.space.step(step)
    return env.get_obs()["pixels"]


class SixColumns(gymnasium.ObservationWrapper):
    """Observations as :func:`six_columns` makes them."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(STATE),), np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """One state."""
        return six_columns(np.asarray(observation))


def make_env(**options: object) -> gymnasium.Env:
    """Makes the simulator, which states as they are recorded come out of."""
    import gym_pusht  # noqa: F401  # registers it

    return SixColumns(gymnasium.make("gym_pusht/PushT-v0", obs_type="state", disable_env_checker=True, **options))


def make_pixels(**options: object) -> gymnasium.Env:
    """Makes the simulator, which pictures and the agent's place come out of."""
    import gym_pusht  # noqa: F401  # registers it

    options |= {"obs_type": "pixels_agent_pos", "observation_width": 96, "observation_height": 96}
    return gymnasium.make("gym_pusht/PushT-v0", disable_env_checker=True, **options)


gymnasium.register(ENV, make_env, max_episode_steps=STEPS, disable_env_checker=True)
gymnasium.register(PIXELS, make_pixels, max_episode_steps=STEPS, disable_env_checker=True)


def run_cell(
    ground: Ground,
    method: str,
    labels: int,
    seed: int,
    executions: dict[str, ExecutionConfig],
    n: int,
    folder: Path,
    source: Path | None = None,
) -> list[tuple[object, ...]]:
    """Trains one method and rolls it out in each way to execute plans; ``source`` is a run whose planner it shares."""
    dataset = folder / ground
    if not (dataset / "ted").is_dir():
        (write_data_set if ground == "pusht" else write_pixels)(dataset)
    plans = get_method(method).plans
    began = time.process_time()
    trained = train(
        TrainConfig(
            dataset=str(dataset),
            out=run_folder(folder, ground, method, labels, seed),
            method=method,
            labels=LabelConfig(count=labels),
            planner=PlannerConfig(source=source if plans else None),
            run=RunConfig(seed=seed, resume=True),
        )
    )
    seconds = time.process_time() - began
    rows = []
    for name, execution in executions.items():
        policy = load_policy(trained, **{k: v for k, v in vars(execution).items() if v is not None})
        episodes = roll_out(
            policy,
            lambda count: make_batch(ground, trained, count),
            list(range(FIRST_SEED, FIRST_SEED + n)),
            max_steps=STEPS,
            batch_size=25,
        )
        rewards = np.array([episode["next", "reward"].max().item() for episode in episodes])
        planner = trained.results["planner" if plans else "controller"]
        score = planner.get("best_held_out_score")
        rows.append(
            (
                *(ground, method, labels, seed, name, n),
                f"{rewards.mean():.4f}",
                f"{rewards.std() / n**0.5:.4f}",
                int((rewards >= 0.999).sum()),
                "" if score is None else f"{score:.4f}",
                planner.get("kept_update", ""),
                f"{seconds:.0f}",
            )
        )
    return rows


def make_batch(ground: Ground, trained: Trained, count: int) -> GymnasiumBatch:
    """Makes environments side by side, whose pictures the run's own encoder embeds."""
    observe = Observer.of(trained.task, trained.cameras)
    return GymnasiumBatch(ENV if ground == "pusht" else PIXELS, trained.task, count, observe=observe, max_steps=STEPS)


def run_folder(folder: Path, ground: str, method: str, labels: int, seed: int) -> Path:
    """Where a cell is trained."""
    return folder / f"{ground}-{method}-{labels}-{seed}"


def main(
    *,
    ground: Ground = "pusht",
    methods: tuple[str, ...] = ("koap", "koap_untrained", "linear_steps", "dp"),
    labels: int = 10,
    seeds: int = 3,
    n: int = 150,
    folder: Path = Path("runs/proving_grounds"),
    results: Path = RESULTS,
) -> None:
    """Runs the cells that the table lacks.

    Args:
        ground: what is seen: states, or frames beside the agent's place.
        methods: what is compared; the first one plans, and the others share its planner.
        labels: demonstrations whose actions may be seen.
        seeds: number of training seeds, from 0.
        n: rollouts per cell, with the seeds from 100,000 on.
        folder: where to train.
        results: the table.
    """
    lookup([name for name in METHODS if get_method(name).plans], methods[0], "first method, which plans")
    torch.set_num_threads(1)
    done, write = open_table(results, COLUMNS, KEYS)
    executions = {
        "default": ExecutionConfig(),
        "open_loop_8": ExecutionConfig(strategy="open_loop", replan_interval=8),
        "temperature_1": ExecutionConfig(temperature=1.0),
    }
    for seed in range(seeds):
        for method in methods:
            cell = (ground, method, labels, seed)
            ways = executions if get_method(method).plans else {"default": ExecutionConfig()}  # sampled actions
            asked = {name: way for name, way in ways.items() if tuple(map(str, (*cell, name, n))) not in done}
            first = run_folder(folder, ground, methods[0], labels, seed)
            for row in run_cell(*cell, asked, n, folder, None if method == methods[0] else first) if asked else ():
                write(row)
                print(*row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
