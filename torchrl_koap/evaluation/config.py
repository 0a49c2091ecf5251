# This source code is licensed under the MIT license found in the LICENSE file.
"""What `koap eval` is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.runs.device import check_machine
from torchrl_koap.runs.plugins import Plugins

MOST_EPISODES = 100_000  # kept in memory


@dataclass
class EvalConfig:
    """Rollouts of a trained run in closed loop; without an environment plans and actions on recorded data.

    Attributes:
        episodes: number of rollouts; tasks with contexts take the fixed ones of the evaluation table in turn.
        rollouts_per_context: rollouts in each context; from 2 on the entropy of the modes per context is known.
        seed: seed of the first rollout; the others count on from it.
        execution: how plans become actions; what is not asked for is the run's, the method's, the task's.
        out: folder to evaluate in instead of the run's own; what the run is made of is copied there.
        batch_size: episodes at a time; results do not depend on it.
        contexts_file: a context file of D3IL to take instead of the table.
        env: id of a Gymnasium environment to roll out in instead of the task's own, such as "my_package:Reach-v0".
        success_key: entry of its info that says whether the task is done (default: "is_success" or "success" where it
            has one of them, else an episode that terminates with a positive reward).
        dataset: for a task without an environment: where the data set of the training is now (default: where it was).
        samples: for a task without an environment: plans that are sampled in each recorded situation.
        threads: torch and simulator threads (default: as many as torch has).
        device: "cpu" or "cuda".
        plugins: modules that register tasks, methods or pictures, besides those that the run was trained with.

    Examples:
        >>> from torchrl_koap.evaluation import EvalConfig, evaluate
        >>> evaluate("runs/koap", EvalConfig(episodes=20))["rates"]["success"]  # doctest: +SKIP
    """

    episodes: int = 60
    rollouts_per_context: int = 1
    seed: int = 100
    execution: Annotated[ExecutionConfig, tyro.conf.arg(name="")] = ExecutionConfig()
    out: Path | None = None
    batch_size: int | None = None
    contexts_file: Path | None = None
    env: str | None = None
    success_key: str | None = None
    dataset: str | None = None
    samples: int = 16
    threads: int | None = None
    device: str = "cpu"
    plugins: Plugins = ()


def check_options(config: EvalConfig) -> None:
    """Refuses what no run could be evaluated with, before any of it is loaded.

    Args:
        config (EvalConfig): what was asked for.

    Raises:
        ValueError: naming the option.
    """
    for name in ("episodes", "batch_size", "rollouts_per_context", "samples"):
        value = getattr(config, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    if config.episodes > MOST_EPISODES:
        raise ValueError(
            f"episodes must be at most {MOST_EPISODES:,}, which are kept in memory, got {config.episodes:,}"
        )
    check_machine(config.threads, config.device)
    if config.seed < 0:
        raise ValueError(f"seed must be >= 0, got {config.seed}")
    if config.success_key is not None and config.env is None:
        raise ValueError(
            f"success_key was given, but no env that could report {config.success_key!r}: name an environment of"
            " Gymnasium with --env"
        )
