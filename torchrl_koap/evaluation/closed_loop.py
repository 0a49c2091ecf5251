# This source code is licensed under the MIT license found in the LICENSE file.
"""Closed-loop evaluation of a run directory: rollouts, scores with intervals."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from torchrl_koap.evaluation.config import EvalConfig, check_options
from torchrl_koap.evaluation.environments import choose_contexts, environment_of
from torchrl_koap.evaluation.latency import measure_latency
from torchrl_koap.evaluation.loop_on_labels import limited_commands
from torchrl_koap.evaluation.offline import evaluate_actions, evaluate_offline
from torchrl_koap.evaluation.policies import trained_policy
from torchrl_koap.evaluation.rollouts import roll_out, rollouts_to_tensors
from torchrl_koap.evaluation.scores import score, task_scores
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.pretrained import writable_folder
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import save_tensors
from torchrl_koap.training.trained import Trained


def evaluate(run: str | Path, config: EvalConfig | None = None) -> dict[str, Any]:
    """Evaluates a run in closed loop; writes ``eval.json`` and ``rollouts.safetensors``. ``koap eval`` calls this.

    A task without an environment is judged on recorded data instead
    (:func:`~torchrl_koap.evaluation.offline.evaluate_offline`), and there is ``eval.json`` alone. Actions outside the
    label budget are read, for evaluation only (``actions.safetensors``).

    Args:
        run (str or Path): a run directory, or ``pretrained:NAME``, a trained policy of the repository.
        config (EvalConfig, optional): how many rollouts, and how. Default: 60 as in training.

    Returns:
        dict: what ``eval.json`` holds: success and entropy with intervals, speed, a row per episode; or, with
        ``kind`` ``"offline"``, errors of plans and actions, and no success.

    Raises:
        ValueError: for unknown options or fewer than one episode.
        RunDirectoryError, CheckpointError, PluginError: as :meth:`Trained.load`.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap import ControllerConfig, EvalConfig, PlannerConfig, TrainConfig, evaluate, train
        >>> from torchrl_koap.data import save_demonstrations
        >>> states = [np.random.default_rng(i).normal(size=(30, 4)).cumsum(0) for i in range(6)]
        >>> actions = [np.diff(frames[:, :2], axis=0) if i < 2 else None for i, frames in enumerate(states)]
        >>> with tempfile.TemporaryDirectory() as root:
        ...     arm = save_demonstrations(root + "/arm", states, actions, control_hz=30, robot=[0, 1])
        ...     few = {"planner": PlannerConfig(steps=2), "controller": ControllerConfig(steps=2)}
        ...     _ = train(TrainConfig(dataset=str(arm), out=Path(root) / "run", **few))
        ...     scores = evaluate(root + "/run", EvalConfig(samples=2, threads=1))
        >>> scores["kind"], scores["relative_plan_error"] > 0  # without an environment: on recorded data
        ('offline', True)
    """
    config = EvalConfig() if config is None else config
    check_options(config)
    set_up_torch(config.threads, config.device)
    load_plugins(config.plugins)
    trained = Trained.load(writable_folder(run, config.out))
    directory, task = RunDirectory(trained.folder), trained.task
    if task.env is None and config.env is None:
        return _judge_offline(trained, config)
    if config.execution.strategy == "oracle" and config.env is not None:
        raise ValueError("the strategy 'oracle' reads the task's own simulation; it cannot be combined with env")
    policy = trained_policy(trained, config.execution)
    seeds = list(range(config.seed, config.seed + config.episodes))
    where = environment_of(task, config)
    errors, actions = evaluate_actions(trained, config.dataset)
    policy = policy.to(config.device)
    with progress_bar(config.episodes, "rollouts", unit="episode") as bar:
        episodes = roll_out(
            policy,
            where.make_env,
            seeds,
            max_steps=where.max_steps,
            batch_size=config.batch_size,
            contexts=where.contexts,
            progress=count_up_to(bar),
        )
    result = score(
        episodes,
        seeds,
        num_modes=where.num_modes,
        mode_index=where.mode_index,
        contexts=where.numbers,
        unsolved="zero" if task.modes.entropy == "contexts" else "skip",
    )
    if config.env is None:
        result = task_scores(task, result, episodes, where.numbers)
    rows = result.pop("episode")
    learned = config.execution if policy.execution.strategy != "oracle" else ExecutionConfig()
    timed = policy if learned is config.execution else trained_policy(trained, learned).to(config.device)
    result |= measure_latency(timed, task.observation_dim)
    result |= errors | limited_commands(policy) | {"execution": asdict(policy.execution), "episode": rows}
    if config.env is not None:
        result |= {"env": config.env, "success_key": config.success_key}
    rollouts = rollouts_to_tensors(
        [episode.cpu() for episode in episodes],
        position=task.observation[task.position],
        mode_index=where.mode_index,
        interval=policy.execution.replan_interval,
        objects=[task.observation[body.position] for body in task.bodies] if config.env is None else (),
        plans_position=task.plans_position,
    )
    if where.contexts is not None:  # in full precision: a film of the same episode starts from it
        rollouts["context"] = torch.from_numpy(where.contexts)
    save_tensors(directory.path / "rollouts.safetensors", rollouts, {"task": task.name})
    if actions:
        save_tensors(directory.path / "actions.safetensors", actions)
    directory.write_json("eval.json", result)
    return result


def _judge_offline(trained: Trained, config: EvalConfig) -> dict[str, Any]:
    """Evaluation without an environment; an earlier one in closed loop cannot have been this task's."""
    choose_contexts(trained.task, 1, config.rollouts_per_context, config.contexts_file)  # refuses what has no meaning
    policy = trained_policy(trained, config.execution)
    asked: dict[str, Any] = {"dataset": config.dataset, "samples": config.samples, "seed": config.seed}
    result, actions = evaluate_offline(trained, **asked, execution=config.execution)
    result |= measure_latency(policy.to(config.device), trained.task.observation_dim)
    result["seed"] = config.seed
    if actions:
        save_tensors(trained.folder / "actions.safetensors", actions)
    RunDirectory(trained.folder).write_json("eval.json", result)
    return result
