# This source code is licensed under the MIT license found in the LICENSE file.
"""Closed-loop evaluation of a run directory: loading it as a policy, rollouts, scores with intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from torchrl_koap.data import LabelBudget
from torchrl_koap.evaluation.offline import evaluate_offline
from torchrl_koap.evaluation.policy_files import (
    BLEND_DECAY,
    PolicyDescription,
    assemble_policy,
    build_networks,
    read_policy,
)
from torchrl_koap.evaluation.rollouts import measure_latency, roll_out, rollouts_to_tensors
from torchrl_koap.evaluation.scores import score, task_scores
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import RecedingHorizonPolicy, StatePlanner
from torchrl_koap.modules.policies.plan_then_control import EXECUTIONS
from torchrl_koap.tasks import HISTORY, REPLAN_INTERVAL, WINDOW, Task, task_of
from torchrl_koap.training.builders import method_named, set_up_torch
from torchrl_koap.training.checkpoints import CheckpointError, load_weights, save_tensors
from torchrl_koap.training.digests import check_digests
from torchrl_koap.training.methods import Method
from torchrl_koap.training.plugins import Plugins, load_plugins
from torchrl_koap.training.pretrained import PREFIX, copy_run, find_run
from torchrl_koap.training.progress import count_up_to, progress_bar
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

CONTROLLERS = ("learned", "oracle")
MOST_EPISODES = 100_000


@dataclass
class EvalConfig:
    """Rollouts of a trained run in closed loop; without an environment plans and actions on recorded data.

    Attributes:
        episodes: number of rollouts; tasks with contexts take the fixed ones of the evaluation table in turn.
        rollouts_per_context: rollouts in each context; from 2 on the entropy of the modes per context is known.
        seed: seed of the first rollout; the others count on from it.
        controller: "learned", or "oracle": the simulator's own inverse map, which takes the tool where the plan says:
            what fails then is the planner's.
        execution: "feedback" (decode at every step) or "open_loop" (decode once per plan) (default: feedback, or the
            task's).
        solver: another solver than in training: ddpm, ddim, dpm++2m, euler, heun.
        solver_steps: another number of solver steps.
        replan_interval: control steps per plan (default: 4, or the task's).
        blend_decay: share of the distance between state and plan that is left after each step; 0: plans as they are
            (default: 0.8, or the task's).
        candidates: plans (of dp: action chunks) sampled whenever one is due, one of which is taken that goes on with
            the one in force (default: as the run says, else 1).
        choice: rule of that choice: "quarter", "typical" or "nearest".
        out: folder to evaluate in instead of the run's own; what the run is made of is copied there.
        batch_size: episodes at a time; results do not depend on it.
        contexts_file: a context file of D3IL to take instead of the table.
        env: id of a Gymnasium environment to roll out in instead of the task's own, such as "my_package:Reach-v0".
        success_key: entry of its info that says whether the task is done (default: "is_success" or "success" where it
            has one of them, else an episode that terminates with a positive reward).
        task: refuse a run of another task than this.
        dataset: for a task without an environment: where the data set of the training is now (default: where it was).
        samples: for a task without an environment: plans that are sampled in each recorded situation.
        threads: torch and simulator threads.
        device: "cpu" or "cuda".
        plugins: modules that register tasks, methods or pictures, besides those that the run was trained with.

    Examples:
        >>> from torchrl_koap.evaluation import EvalConfig, evaluate
        >>> evaluate("runs/koap", EvalConfig(episodes=20, execution="open_loop"))["success_rate"]  # doctest: +SKIP
    """

    episodes: int = 60
    rollouts_per_context: int = 1
    seed: int = 100
    controller: str = "learned"
    execution: str | None = None
    solver: str | None = None
    solver_steps: int | None = None
    replan_interval: int | None = None
    blend_decay: float | None = None
    candidates: int | None = None
    choice: str = "quarter"
    out: Path | None = None
    batch_size: int | None = None
    contexts_file: Path | None = None
    env: str | None = None
    success_key: str | None = None
    task: str | None = None
    dataset: str | None = None
    samples: int = 16
    threads: int = 2
    device: str = "cpu"
    plugins: Plugins = ()


@dataclass(frozen=True)
class TrainedRun:
    """A finished run: its networks with their weights, and what they were trained on.

    Args:
        directory (RunDirectory): its folder.
        config (dict): its ``config.json``.
        task (Task): the task.
        method (Method): the method.
        planner (StatePlanner, optional): None for a policy of its own.
        controller (nn.Module): the controller, or the policy.
        columns (tuple of int): state columns that the controller reads.

    Examples:
        >>> from torchrl_koap.evaluation.run import load_run
        >>> trained = load_run("runs/koap")  # doctest: +SKIP
        >>> trained.method.name, trained.budget.amount  # doctest: +SKIP
        ('koap', 0.02)
    """

    directory: RunDirectory
    config: dict[str, Any]
    task: Task
    method: Method
    planner: StatePlanner | None
    controller: nn.Module
    columns: tuple[int, ...]

    @property
    def budget(self) -> LabelBudget:
        """The label budget it was trained with."""
        episodes = self.config.get("label_episodes")
        if episodes is not None:
            return LabelBudget.of_episodes(episodes)
        names = ("label_count", "label_fraction", "label_unit", "seed")
        count, fraction, unit, seed = (self.directory.read_entry("config.json", name) for name in names)
        return LabelBudget(fraction if count is None else count, unit=unit, seed=seed, window=WINDOW, history=HISTORY)


def load_run(run: str | Path, *, task: str | None = None) -> TrainedRun:
    """Loads a finished run, its networks in evaluation mode; the plugins it was trained with are imported first.

    Args:
        run (str or Path): its folder.

    Keyword Args:
        task (str, optional): refuse a run of another task.

    Raises:
        RunDirectoryError: if the folder is no finished run, one of another task than asked for, or one whose files are
            not those that its training left.
        CheckpointError: if weights are damaged, of another task or without their statistics.
        PluginError: if a plugin of the run cannot be imported.
    """
    directory = RunDirectory(run)
    trained_on, planner_entry, entry = (
        directory.read_entry("config.json", name) for name in ("task", "planner", "controller")
    )
    if task is not None and task != trained_on:
        raise RunDirectoryError(f"{directory.path} was trained on task {trained_on!r}, not on {task!r}")
    config = directory.read_json("config.json")
    load_plugins(config.get("plugins") or ())
    try:
        facts, method = task_of(config), method_named(entry)
        planner, controller, columns = build_networks(facts, method, planner_entry, entry)
    except (KeyError, ValueError) as error:
        problem = f"an entry {error} is missing" if isinstance(error, KeyError) else error
        raise RunDirectoryError(f"{directory.path / 'config.json'} cannot be used: {problem}") from error
    for name, module in {"planner": planner, "controller": controller}.items():
        if module is not None:
            load_weights(directory.path / f"{name}.safetensors", module, task=facts.name)
    check_digests(directory)
    return TrainedRun(directory, config, facts, method, planner, controller, columns)


def load_policy(run: str | Path | TrainedRun, config: EvalConfig | None = None) -> RecedingHorizonPolicy:
    """A run, or a file of :func:`~torchrl_koap.save_policy`, as a policy: observations in, an action per step out.

    An environment needs :func:`~torchrl_koap.modules.policy_transforms` of ``policy.history`` for it, which hand it the
    last observations; an :class:`~torchrl_koap.modules.Agent` keeps them itself.

    Args:
        run (str, Path or TrainedRun): a run directory, what :func:`load_run` made of one, or a file.
        config (EvalConfig, optional): execution, solver, interval between plans, device and plugins; the rest is not
            used. What is not asked for is as ``koap eval`` has it, for a file as it was saved.

    Raises:
        ValueError: for an unknown execution or solver, or an interval out of range.
        RunDirectoryError, CheckpointError, PluginError: as :func:`load_run`; a :class:`CheckpointError` names the file.
    """
    given, config = config, EvalConfig() if config is None else config
    _check_execution(config)
    lookup(CONTROLLERS, config.controller, "controller")
    names = ("execution", "replan_interval", "blend_decay", "choice", "candidates")
    options = {name: getattr(config, name) for name in names if getattr(config, name) is not None}
    if config.controller == "oracle":
        trained = run if isinstance(run, TrainedRun) else load_run(run, task=config.task)
        policy = _oracle(trained, options | _execution(trained, config))
    elif isinstance(run, (str, Path)) and Path(run).is_file():
        policy = read_policy(run, plugins=config.plugins, **({} if given is None else options))
        trained_on = policy.description.task.name
        if config.task not in (None, trained_on):
            raise CheckpointError(f"{run} was trained on task {trained_on!r}, not on {config.task!r}")
    else:
        trained = run if isinstance(run, TrainedRun) else load_run(run, task=config.task)
        if trained.planner is None and config.execution not in (None, "feedback"):
            raise ValueError(
                f"execution {config.execution!r} was asked of {trained.directory.path}, but method"
                f" {trained.method.name!r} is a policy of its own: it executes chunks of actions"
            )
        description = PolicyDescription(
            trained.task,
            trained.config["planner"],
            trained.config["controller"],
            trained.columns,
            tuple(trained.config.get("plugins") or ()),
        )
        kept: dict[str, Any] = {"candidates": trained.config.get("candidates") or 1}
        policy = assemble_policy(
            trained.planner, trained.controller, description, **kept | options | _execution(trained, config)
        )
    if config.solver is not None:
        policy.planner.solver = config.solver
    if config.solver_steps is not None:
        policy.planner.num_steps = config.solver_steps
    return policy.to(config.device)


def _check_execution(config: EvalConfig) -> None:
    if config.execution is not None:
        lookup(EXECUTIONS, config.execution, "execution")


def _execution(trained: TrainedRun, config: EvalConfig) -> dict[str, Any]:
    """How plans are followed: as was asked for, else as the task has it, else in feedback."""
    options: dict[str, Any] = {"execution": "feedback", "replan_interval": REPLAN_INTERVAL, "blend_decay": BLEND_DECAY}
    own = dict(trained.task.defaults.execution)
    if trained.planner is None or config.controller == "oracle":  # chunks are executed as they are; an oracle looks
        own.pop("execution", None)
    asked = {name: getattr(config, name) for name in options if getattr(config, name) is not None}
    return options | own | asked


def _oracle(trained: TrainedRun, options: dict[str, Any]) -> RecedingHorizonPolicy:
    """The run's planner with the simulator's inverse map."""
    if trained.planner is None:
        raise ValueError(
            f"{trained.directory.path} was trained with method {trained.method.name!r}, which has no planner: there is"
            " nothing that the oracle controller could follow"
        )
    if trained.task.env is None:
        raise ValueError(f"task {trained.task.name!r} has no environment, whose simulation the oracle controller reads")
    from torchrl_koap.evaluation.oracle import OracleControl

    kept = {"candidates": trained.config.get("candidates") or 1}
    history = max(trained.planner.history, getattr(trained.controller, "num_past", 0) + 1)
    rule = trained.task.action_rule if trained.task.gripper is not None else None
    return OracleControl(trained.planner, trained.task, history=history, action_rule=rule, **kept | options)


def choose_contexts(
    task: Task, episodes: int, rollouts_per_context: int = 1, contexts_file: Path | None = None
) -> tuple[list[int] | None, np.ndarray | None]:
    """Number of the context of every rollout, and the contexts; None for a task in which all episodes start alike.

    Args:
        task (Task): the task.
        episodes (int): number of rollouts.
        rollouts_per_context (int): rollouts in each context.
        contexts_file (Path, optional): a context file of D3IL instead of the evaluation table.

    Raises:
        ValueError: if there are too few contexts, or the task has none.
    """
    if not task.objects:
        given = {"contexts_file": contexts_file is not None, "rollouts_per_context": rollouts_per_context != 1}
        for name, unfit in given.items():
            if unfit:
                raise ValueError(f"{name} was given, but task {task.name!r} has no contexts")
        return None, None
    from torchrl_koap.envs.contexts import evaluation_contexts, load_contexts  # takes seconds

    if contexts_file is None:
        table = evaluation_contexts(task)
    else:
        table = load_contexts(contexts_file, task)
    needed = (episodes - 1) // rollouts_per_context + 1
    if needed > len(table):
        raise ValueError(
            f"{episodes} episodes with {rollouts_per_context} per context need {needed} contexts,"
            f" there are {len(table)}"
        )
    numbers = [episode // rollouts_per_context for episode in range(episodes)]
    return numbers, table[numbers]


@dataclass(frozen=True)
class _Place:
    """Where a run is rolled out."""

    make_env: Callable[[int], Any]
    max_steps: int
    mode_index: Callable[[torch.Tensor], torch.Tensor]
    num_modes: int
    numbers: list[int] | None = None
    contexts: np.ndarray | None = None


def _place(task: Task, config: EvalConfig) -> _Place:
    """The task's own environment, or the one of Gymnasium that was asked for."""
    if config.env is None:
        numbers, contexts = choose_contexts(task, config.episodes, config.rollouts_per_context, config.contexts_file)
        from torchrl_koap.envs.registry import make_env_of, mode_index_of  # takes seconds

        make_env = make_env_of(task, num_threads=config.threads)
        return _Place(make_env, task.max_steps, mode_index_of(task), task.num_modes, numbers, contexts)
    for name, unfit in {
        "contexts_file": config.contexts_file is not None,
        "rollouts_per_context": config.rollouts_per_context != 1,
    }.items():
        if unfit:
            raise ValueError(f"{name} was given, but an environment of Gymnasium has no contexts")
    from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch

    make_env = partial(GymnasiumBatch, config.env, task, success_key=config.success_key)
    probe = make_env(1)
    probe.close()
    return _Place(make_env, probe.max_steps, _only_mode, 1)


def _only_mode(mode: torch.Tensor) -> torch.Tensor:
    return mode[..., 0]


def evaluate(run: str | Path, config: EvalConfig | None = None) -> dict[str, Any]:
    """Evaluates a run in closed loop; writes ``eval.json`` and ``rollouts.safetensors``. ``koap eval`` calls this.

    A task without an environment is judged on recorded data instead
    (:func:`~torchrl_koap.evaluation.offline.evaluate_offline`), and there is ``eval.json`` alone.

    Args:
        run (str or Path): a run directory, or ``pretrained:NAME``, a trained policy of the repository.
        config (EvalConfig, optional): how many rollouts, and how. Default: 60 as in training.

    Returns:
        dict: what ``eval.json`` holds: success and entropy with intervals, speed, a row per episode; or, with
        ``kind`` ``"offline"``, errors of plans and actions, and no success.

    Raises:
        ValueError: for unknown options or fewer than one episode.
        RunDirectoryError, CheckpointError, PluginError: as :func:`load_run`.
    """
    config = EvalConfig() if config is None else config
    for name in ("episodes", "batch_size", "rollouts_per_context", "samples"):
        value = getattr(config, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    if config.episodes > MOST_EPISODES:
        raise ValueError(
            f"episodes must be at most {MOST_EPISODES:,}, which are kept in memory, got {config.episodes:,}"
        )
    if config.seed < 0:
        raise ValueError(f"seed must be >= 0, got {config.seed}")
    _check_execution(config)
    if config.success_key is not None and config.env is None:
        raise ValueError(
            f"success_key was given, but no env that could report {config.success_key!r}: name an environment of"
            " Gymnasium with --env"
        )
    set_up_torch(config.threads, config.device)
    lookup(CONTROLLERS, config.controller, "controller")
    load_plugins(config.plugins)
    trained = load_run(_folder(run, config), task=config.task)
    directory, task = trained.directory, trained.task
    if task.env is None and config.env is None:
        return _judge_offline(trained, config)
    if config.controller == "oracle" and config.env is not None:
        raise ValueError("the oracle controller reads the task's own simulation; it cannot be combined with env")
    if config.dataset is not None:
        raise ValueError(f"dataset is for judging without an environment; task {task.name!r} is rolled out in one")
    policy, execution = load_policy(trained, config), _execution(trained, config)
    sampler = trained.controller if trained.planner is None else trained.planner
    seeds = list(range(config.seed, config.seed + config.episodes))
    place = _place(task, config)
    with progress_bar(config.episodes, "rollouts", unit="episode") as bar:
        episodes = roll_out(
            policy,
            place.make_env,
            seeds,
            max_steps=place.max_steps,
            batch_size=config.batch_size,
            contexts=place.contexts,
            progress=count_up_to(bar),
        )
    unsolved = "zero" if task.modes.entropy == "contexts" else "skip"
    result = score(
        episodes,
        seeds,
        num_modes=place.num_modes,
        mode_index=place.mode_index,
        contexts=place.numbers,
        unsolved=unsolved,
    )
    if config.env is None:
        result |= task_scores(task, result, episodes, place.numbers)
    rows = result.pop("episode")
    timed = policy if config.controller == "learned" else load_policy(trained, replace(config, controller="learned"))
    result |= measure_latency(timed, task.observation_dim)
    result |= {
        "controller": config.controller,
        **execution,
        "execution": "chunks" if trained.planner is None else execution["execution"],
        "solver": sampler.solver,
        "solver_steps": sampler.num_steps,
        "candidates": policy.candidates,
        "episode": rows,
    }
    if config.env is not None:
        result |= {"env": config.env, "success_key": config.success_key}
    rollouts = rollouts_to_tensors(
        [episode.cpu() for episode in episodes],
        position=task.observation[task.position],
        mode_index=place.mode_index,
        interval=execution["replan_interval"],
        objects=[task.observation[part] for part in task.plotted.values()] if config.env is None else (),
        plans_position=task.plans_position,
    )
    if place.contexts is not None:  # in full precision: a film of the same episode starts from it
        rollouts["context"] = torch.from_numpy(place.contexts)
    save_tensors(directory.path / "rollouts.safetensors", rollouts, {"task": task.name})
    directory.write_json("eval.json", result)
    return result


def _folder(run: str | Path, config: EvalConfig) -> Path:
    """The folder to evaluate in: the run's own, or a copy of what it is made of."""
    source = find_run(run)
    if config.out is None:
        if str(run).startswith(PREFIX):
            raise ValueError(f"{run} is evaluated in a folder of your own: name it with --out")
        return source
    if config.task is not None:  # before anything is copied
        load_run(source, task=config.task)
    return copy_run(source, config.out)


def _judge_offline(trained: TrainedRun, config: EvalConfig) -> dict[str, Any]:
    """Evaluation without an environment; an earlier one in closed loop cannot have been this task's."""
    choose_contexts(trained.task, 1, config.rollouts_per_context, config.contexts_file)  # refuses what has no meaning
    policy = load_policy(trained, config)
    result = evaluate_offline(trained, dataset=config.dataset, samples=config.samples, seed=config.seed)
    sampler = trained.controller if trained.planner is None else trained.planner
    result |= measure_latency(policy.to(config.device), trained.task.observation_dim)
    result |= {"solver": sampler.solver, "solver_steps": sampler.num_steps, "seed": config.seed}
    trained.directory.write_json("eval.json", result)
    return result
