# This source code is licensed under the MIT license found in the LICENSE file.
"""Closed-loop evaluation of a run directory: rollouts, and scores with intervals."""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap.evaluation.config import EvalConfig, environment_arguments
from torchrl_koap.evaluation.latency import measure_latency
from torchrl_koap.evaluation.offline import evaluate_actions, evaluate_offline
from torchrl_koap.evaluation.policies import trained_policy
from torchrl_koap.evaluation.rollout_faults import limited_commands, stall_faults, standing_faults, start_faults
from torchrl_koap.evaluation.rollouts import roll_out, rollouts_to_tensors
from torchrl_koap.evaluation.scores import outcome_of, score, task_scores
from torchrl_koap.evaluation.statistics import bootstrap_interval
from torchrl_koap.files import read_json
from torchrl_koap.runs.config import given_options
from torchrl_koap.runs.config_files import to_json
from torchrl_koap.runs.device import default_threads, set_up_torch, torch_as_before
from torchrl_koap.runs.plugins import PluginError, load_plugins
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.runs.run_directory import RunDirectory, find_run, writable_folder
from torchrl_koap.runs.weights import save_tensors
from torchrl_koap.tasks import Modes, Task
from torchrl_koap.training.trained import Trained
from torchrl_koap.vision import Observer, Projection

if TYPE_CHECKING:
    from torchrl_koap.envs.gymnasium_batch import EpisodeRecord  # takes seconds


@torch_as_before()
def evaluate(run: str | Path, config: EvalConfig | None = None) -> dict[str, Any]:
    """Evaluates a run in closed loop; writes ``eval.json`` and ``rollouts.safetensors``. ``koap eval`` calls this.

    A task without an environment is evaluated on recorded data instead
    (:func:`~torchrl_koap.evaluation.offline.evaluate_offline`), without ``rollouts.safetensors``. Actions outside the
    label budget are read, for evaluation only (``actions.safetensors``).

    Args:
        run (str or Path): a run directory, or ``pretrained:NAME``, a trained policy of the repository.
        config (EvalConfig, optional): the options. Default: 60 rollouts with the execution of the training.

    Returns:
        dict: the contents of ``eval.json``: success and entropy with intervals, speed, a row per episode; or, with
        ``kind`` ``"offline"``, errors of plans and actions, and no success.

    Raises:
        ValueError: for options that do not fit the task.
        RunDirectoryError, CheckpointError, PluginError: as :meth:`Trained.load`.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_koap import EvalConfig, evaluate
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     config = EvalConfig(episodes=2, threads=1, out=Path(folder, "run"))
        ...     result = evaluate("pretrained:avoiding", config)
        >>> result["rates"]["success"]["episodes"]
        2
    """
    config = given_options(config, EvalConfig)
    set_up_torch(config.threads or default_threads(), config.device)
    trained = Trained.load(run, plugins=config.plugins)
    task = trained.task
    if task.env is None and config.env is None:
        return _judge_offline(run, trained, config)
    if config.execution.strategy == "oracle" and config.env is not None:
        raise ValueError("the strategy 'oracle' reads the task's own simulation; it cannot be combined with env")
    policy = trained_policy(trained, config.execution)
    seeds = list(range(config.seed, config.seed + config.episodes))
    where = find_environment(task, config, trained.cameras)
    errors, actions, data = evaluate_actions(trained, config.dataset)
    directory = RunDirectory(writable_folder(run, config.out))  # after all checks: a refused call copies nothing
    policy = policy.to(config.device)
    with progress_bar(config.episodes, "rollouts", unit="episode") as bar:
        episodes = roll_out(
            policy,
            where.make_env,
            seeds,
            max_steps=where.max_steps,
            batch_size=config.num_envs or config.batch_size,
            contexts=where.contexts,
            progress=count_up_to(bar),
        )
    result = score(episodes, seeds, where.modes, contexts=where.numbers)
    if config.env is None:
        result = task_scores(task, result, episodes, where.numbers)
    rows = result.pop("episode")
    result |= errors | limited_commands(policy)  # before measure_latency, whose commands would count too
    timed = trained.policy().to(config.device) if policy.execution.strategy == "oracle" else policy
    result |= measure_latency(timed, task.observation_dim)
    result |= {"execution": to_json(policy.execution), "episode": rows}
    result |= where.facts
    if where.record is not None:
        result |= {"clipped_actions": where.record.clipped, "errors": where.record.errors} | _returns(episodes, rows)
        result["faults"] = [*result.get("faults", ()), *where.record.faults()]
        if where.facts["success_key"] is None and not result["rates"]["success"]["rate"]:
            result["faults"].append(
                "no episode reported success in info or ended with more than twice any earlier reward: name the entry"
                " with --success-key, or compare mean returns"
            )
    sound = [episode for episode in episodes if outcome_of(episode) != "error"]
    failed = [episode for episode in sound if outcome_of(episode) != "success"]
    if data is not None and failed:
        found = stall_faults(failed, data)
        if where.record is not None:
            found = (standing_faults(failed, data) or found) + start_faults(sound, data, task)
        result |= {"faults": [*result.get("faults", ()), *found]} if found else {}
    rollouts = rollouts_to_tensors(
        episodes,
        replace(task, modes=where.modes),
        interval=policy.execution.replan_interval,
    )
    if where.contexts is not None:  # in full precision: videos of the episode start from it
        rollouts["context"] = torch.from_numpy(where.contexts)
    save_tensors(directory.path / "rollouts.safetensors", rollouts, {"task": task.name})
    if actions:
        save_tensors(directory.path / "actions.safetensors", actions)
    directory.write_json("eval.json", result)
    return result


def _returns(episodes: Sequence[TensorDict], rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Adds its return to the row of each episode, None if an error cut it short; returns the mean and early ends."""
    for episode, row in zip(episodes, rows, strict=True):
        row["return"] = None if row["outcome"] == "error" else float(episode["next", "reward"].sum())
    returns = [row["return"] for row in rows if row["return"] is not None]
    found: dict[str, Any] = {"mean_return": statistics.fmean(returns) if returns else None}
    if len(returns) > 1:
        found["mean_return_interval"] = bootstrap_interval(returns, statistics.fmean)
    ends = [bool(episode[-1]["next", "terminated"]) for episode in episodes]
    found["ended_early"] = sum(end and row["outcome"] != "success" for end, row in zip(ends, rows, strict=True))
    return found | {"left_out_of_return": len(episodes) - len(returns)}


def _judge_offline(run: str | Path, trained: Trained, config: EvalConfig) -> dict[str, Any]:
    """Evaluates without an environment; refuses to overwrite rollouts in a Gymnasium environment."""
    choose_contexts(trained.task, config)  # refuses options that need an environment
    earlier = find_run(run) / "eval.json"
    if config.out is None and earlier.is_file() and (env := read_json(earlier).get("env")) is not None:
        raise ValueError(
            f"{earlier} holds rollouts in {env}: name another folder with --out for errors on recorded data, or"
            f" roll out again with --env {env}"
        )
    policy = trained_policy(trained, config.execution)
    result, actions = evaluate_offline(trained, config)
    directory = RunDirectory(writable_folder(run, config.out))
    result |= measure_latency(policy.to(config.device), trained.task.observation_dim)
    result |= {"seed": config.seed, "execution": to_json(policy.execution)}
    if actions:
        save_tensors(directory.path / "actions.safetensors", actions)
    directory.write_json("eval.json", result)
    return result


def choose_contexts(task: Task, config: EvalConfig) -> tuple[list[int] | None, np.ndarray | None]:
    """Returns number and pose of the context of every rollout; None where all episodes start alike.

    Raises a ValueError for too few contexts, and for options that need contexts or an environment if there are none.
    """
    if task.env is None and config.env is None:
        for name in ("episodes", "rollouts_per_context", "batch_size", "contexts_file"):
            if getattr(config, name) != getattr(EvalConfig(), name):
                raise ValueError(f"{name}: task {task.name!r} has no environment to roll out in: name one with --env")
        return None, None
    each, file = config.rollouts_per_context, config.contexts_file
    if not task.scene.varies or config.env is not None:
        where = f"task {task.name!r}" if config.env is None else "an environment of Gymnasium"
        for name, given in {"contexts_file": file is not None, "rollouts_per_context": each != 1}.items():
            if given:
                raise ValueError(f"{name} was given, but {where} has no contexts")
        return None, None
    if file is not None and not Path(file).is_file():
        raise ValueError(f"contexts_file: there is no file {file}")
    from torchrl_koap.envs.contexts import evaluation_contexts, load_contexts  # takes seconds

    table = evaluation_contexts(task) if file is None else load_contexts(file, task)
    numbers = [episode // each for episode in range(config.episodes)]
    if numbers[-1] >= len(table):
        wanted = f"{config.episodes} episodes with {each} per context need {numbers[-1] + 1} contexts"
        raise ValueError(f"{wanted}, there are {len(table)}")
    return numbers, table[numbers]


@dataclass(frozen=True)
class RolloutEnvironment:
    """Environment for the rollouts of a run, with its modes and contexts."""

    make_env: Callable[[int], Any]  # makes one with this number of parallel episodes
    max_steps: int
    modes: Modes
    numbers: list[int] | None = None  # number of the context of every rollout
    contexts: np.ndarray | None = None
    record: EpisodeRecord | None = None  # what happened in episodes of a Gymnasium environment
    facts: Mapping[str, Any] = field(default_factory=dict)  # description of it for ``eval.json``


def find_environment(
    task: Task, config: EvalConfig, cameras: Mapping[str, Projection] | None = None
) -> RolloutEnvironment:
    """Finds the task's own environment, or the Gymnasium environment ``config.env``, whose pictures are embedded.

    Raises an error for an environment that does not exist, has other widths than the task or does not report success
    under ``success_key``, and for too few contexts.
    """
    numbers, contexts = choose_contexts(task, config)
    if config.env is None:
        from torchrl_koap.envs.registry import make_env  # takes seconds

        options = {"num_threads": torch.get_num_threads(), "max_steps": task.max_steps}
        make = partial(make_env, task, noisy=True, **options)
        return RolloutEnvironment(make, task.max_steps, task.modes, numbers, contexts)
    from torchrl_koap.envs.gymnasium_batch import EpisodeRecord, GymnasiumBatch

    if ":" in config.env:
        with suppress(PluginError):  # making the environment raises the clearer error
            load_plugins([config.env.partition(":")[0]])
    record = EpisodeRecord()
    make_env = partial(
        GymnasiumBatch,
        config.env,
        task,
        env_kwargs=environment_arguments(config.env_kwargs),
        processes=config.num_envs is not None,
        observe=Observer(task, cameras) if cameras else None,
        success_key=config.success_key,
        record=record,
    )
    probe = make_env(1)
    probe.close()
    own = "--env-kwargs" if "max_episode_steps" in environment_arguments(config.env_kwargs) else "the environment's own"
    limit = own if probe.own_limit else f"that of task {task.name!r}: the environment has none"
    facts = {
        "env": config.env,
        "env_kwargs": list(config.env_kwargs),
        "num_envs": config.num_envs,
        "success_key": probe.success_key,
        "step_limit": f"{probe.max_steps} steps ({limit})",
    }
    if not probe.own_limit:  # before rollouts that may take days
        warnings.warn(
            f"environment {config.env!r} has no step limit: an episode that it does not end lasts {probe.max_steps:,}"
            " steps, the task's limit (--max-steps of `koap convert`); set another with"
            " --env-kwargs max_episode_steps=500",
            stacklevel=2,
        )
    if probe.success_key is None:
        facts["success"] = (  # the first step had no entry, or the environment raised an error there
            "success: info['is_success'] or info['success'] if there is one, else an end with more than twice any"
            " earlier reward"
        )
    return RolloutEnvironment(make_env, probe.max_steps, Modes(), record=record, facts=facts)
