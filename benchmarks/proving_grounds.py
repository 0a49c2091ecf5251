# This source code is licensed under the MIT license found in the LICENSE file.
"""Push-T, demonstrations and simulator of others: the default command of each method, without any tuning.

    python benchmarks/proving_grounds.py --labels 10 --seeds 3

The 206 human demonstrations are those of Chi et al. 2023 (MIT licence). The simulator is no dependency of the package:
``pip install gym-pusht==0.1.8 "pymunk<7"``.

Trains and rolls out every method with every training seed, and appends rows to
``benchmarks/results/proving_grounds.csv``. What is there already is not run again. The planner is that of the first
method. Seconds are those of one core, with the time to read the demonstrations.
"""

from __future__ import annotations

import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro
from tables import open_table

from torchrl_koap import LabelConfig, PlannerConfig, RunConfig, TrainConfig, load_policy, train
from torchrl_koap.data import save_demonstrations
from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.training.methods import METHODS, get_method

RESULTS = Path(__file__).resolve().parent / "results" / "proving_grounds.csv"
DATA = Path(__file__).resolve().parents[2] / "shared" / "proving_grounds" / "pusht_human_206.npz"
GROUND, ENV = "pusht", "torchrl_koap/PushT-v0"
STEPS, FIRST_SEED = 300, 100_000
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


def write_data_set(folder: Path) -> None:
    """Writes the demonstrations, all of them with their actions, as a data set of ``koap train``."""
    if not DATA.is_file():
        raise FileNotFoundError(f"{DATA} is not there: it holds the human demonstrations of Push-T")
    raw = np.load(DATA)
    ends = raw["episode_ends"][:-1]
    save_demonstrations(
        folder,
        np.split(six_columns(raw["state"]), ends),
        np.split(raw["action"].astype(np.float32), ends),
        control_hz=10,
        state_names=list(STATE),
        state_units=list(STATE.values()),
        action_names=["target_x", "target_y"],
        action_units="px",
        robot=["agent_x", "agent_y"],
        action_kind="absolute",
        targets=["agent_x", "agent_y"],
        max_steps=STEPS,
    )


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


gymnasium.register(ENV, make_env, max_episode_steps=STEPS, disable_env_checker=True)


def run_cell(
    method: str,
    labels: int,
    seed: int,
    executions: dict[str, ExecutionConfig],
    n: int,
    folder: Path,
    source: Path | None = None,
) -> list[tuple[object, ...]]:
    """Trains one method and rolls it out in each way to execute plans; ``source`` is a run whose planner it shares."""
    dataset = folder / GROUND
    if not dataset.is_dir():
        write_data_set(dataset)
    plans = get_method(method).plans
    began = time.process_time()
    trained = train(
        TrainConfig(
            dataset=str(dataset),
            out=run_folder(folder, method, labels, seed),
            method=method,
            labels=LabelConfig(count=labels),
            planner=PlannerConfig(source=source if plans else None),
            run=RunConfig(seed=seed, resume=True),
        )
    )
    seconds = time.process_time() - began
    rows = []
    for name, execution in executions.items():
        episodes = roll_out(
            load_policy(trained, **{k: v for k, v in vars(execution).items() if v is not None}),
            lambda count: GymnasiumBatch(ENV, trained.task, count, max_steps=STEPS),
            list(range(FIRST_SEED, FIRST_SEED + n)),
            max_steps=STEPS,
            batch_size=25,
        )
        rewards = np.array([episode["next", "reward"].max().item() for episode in episodes])
        planner = trained.results["planner" if plans else "controller"]
        score = planner.get("best_held_out_score")
        rows.append(
            (
                *(GROUND, method, labels, seed, name, n),
                f"{rewards.mean():.4f}",
                f"{rewards.std() / n**0.5:.4f}",
                int((rewards >= 0.999).sum()),
                "" if score is None else f"{score:.4f}",
                planner.get("kept_update", ""),
                f"{seconds:.0f}",
            )
        )
    return rows


def run_folder(folder: Path, method: str, labels: int, seed: int) -> Path:
    """Where a cell is trained."""
    return folder / f"{GROUND}-{method}-{labels}-{seed}"


def main(
    *,
    methods: tuple[str, ...] = ("koap", "koap_untrained", "linear_steps", "dp"),
    labels: int = 10,
    seeds: int = 3,
    n: int = 150,
    folder: Path = Path("runs/proving_grounds"),
    results: Path = RESULTS,
) -> None:
    """Runs the cells that the table lacks.

    Args:
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
    executions = {"default": ExecutionConfig(), "open_loop_8": ExecutionConfig(strategy="open_loop", replan_interval=8)}
    for seed in range(seeds):
        for method in methods:
            cell = (method, labels, seed)
            ways = executions if get_method(method).plans else {"default": ExecutionConfig()}  # sampled actions
            asked = {name: way for name, way in ways.items() if tuple(map(str, (GROUND, *cell, name, n))) not in done}
            first = run_folder(folder, methods[0], labels, seed)
            for row in run_cell(*cell, asked, n, folder, None if method == methods[0] else first) if asked else ():
                write(row)
                print(*row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
