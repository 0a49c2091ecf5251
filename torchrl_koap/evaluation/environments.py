# This source code is licensed under the MIT license found in the LICENSE file.
"""Environments, contexts and modes of the rollouts of an evaluation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_koap.evaluation.config import EvalConfig
from torchrl_koap.tasks import Task


def choose_contexts(
    task: Task, episodes: int, rollouts_per_context: int = 1, contexts_file: Path | None = None
) -> tuple[list[int] | None, np.ndarray | None]:
    """Returns number and pose of the context of every rollout; None for a task in which all episodes start alike.

    Raises:
        ValueError: if there are too few contexts, or they were asked for where the task has none.
    """
    if not task.objects:
        _refuse_contexts(rollouts_per_context, contexts_file, f"task {task.name!r}")
        return None, None
    from torchrl_koap.envs.contexts import evaluation_contexts, load_contexts  # takes seconds

    table = evaluation_contexts(task) if contexts_file is None else load_contexts(contexts_file, task)
    needed = (episodes - 1) // rollouts_per_context + 1
    if needed > len(table):
        raise ValueError(
            f"{episodes} episodes with {rollouts_per_context} per context need {needed} contexts,"
            f" there are {len(table)}"
        )
    numbers = [episode // rollouts_per_context for episode in range(episodes)]
    return numbers, table[numbers]


def _refuse_contexts(rollouts_per_context: int, contexts_file: Path | None, where: str) -> None:
    given = {"contexts_file": contexts_file is not None, "rollouts_per_context": rollouts_per_context != 1}
    for name, unfit in given.items():
        if unfit:
            raise ValueError(f"{name} was given, but {where} has no contexts")


@dataclass(frozen=True)
class EvaluationEnv:
    """Where a run is rolled out."""

    make_env: Callable[[int], Any]  # of a number of parallel episodes
    max_steps: int
    mode_index: Callable[[torch.Tensor], torch.Tensor]  # from the environment's leaf ``mode``
    num_modes: int
    numbers: list[int] | None = None  # of the context of every rollout
    contexts: np.ndarray | None = None


def environment_of(task: Task, config: EvalConfig) -> EvaluationEnv:
    """Returns the task's own environment, or the one of Gymnasium that was asked for.

    Raises:
        ValueError: if there are too few contexts, or they were asked for where there are none.
    """
    if config.env is None:
        numbers, contexts = choose_contexts(task, config.episodes, config.rollouts_per_context, config.contexts_file)
        from torchrl_koap.envs.registry import make_env_of, mode_index_of  # takes seconds

        make_env = make_env_of(task, num_threads=config.threads or torch.get_num_threads())
        return EvaluationEnv(make_env, task.max_steps, mode_index_of(task), task.num_modes, numbers, contexts)
    _refuse_contexts(config.rollouts_per_context, config.contexts_file, "an environment of Gymnasium")
    from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch

    make_env = partial(GymnasiumBatch, config.env, task, success_key=config.success_key)
    probe = make_env(1)
    probe.close()
    return EvaluationEnv(make_env, probe.max_steps, lambda mode: mode[..., 0], 1)
