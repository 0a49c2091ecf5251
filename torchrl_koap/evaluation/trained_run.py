# This source code is licensed under the MIT license found in the LICENSE file.
"""A run directory as networks with their weights, and as a policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import nn

from torchrl_koap.data import LabelBudget
from torchrl_koap.evaluation.policy_files import (
    PolicyDescription,
    build_networks,
    default_execution,
    policy_of,
    read_policy,
)
from torchrl_koap.modules import Execution, ExecutionConfig, PlanningPolicy, StatePlanner
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.runs.weights import load_weights
from torchrl_koap.tasks import Task, task_of
from torchrl_koap.training.builders import method_named
from torchrl_koap.training.digests import check_digests
from torchrl_koap.training.method import Method


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
        >>> from torchrl_koap.evaluation.trained_run import load_run
        >>> trained = load_run("runs/koap")  # doctest: +SKIP
        >>> trained.method.name, trained.budget.count  # doctest: +SKIP
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
            return LabelBudget(episodes=episodes)
        names = ("label_count", "label_fraction", "label_unit", "seed")
        count, fraction, unit, seed = (self.directory.read_entry("config.json", name) for name in names)
        return LabelBudget(fraction=fraction if count is None else None, count=count, unit=unit, seed=seed)


def load_run(run: str | Path, *, task: str | None = None) -> TrainedRun:
    """Loads a finished run, its networks in evaluation mode; the plugins it was trained with are imported first.

    Args:
        run (str or Path): its folder, or ``"pretrained:NAME"``.

    Keyword Args:
        task (str, optional): refuse a run of another task.

    Returns:
        TrainedRun: networks with their weights, in evaluation mode.

    Raises:
        RunDirectoryError: if the folder is no finished run, one of another task than asked for, or one whose files are
            not those that its training left.
        CheckpointError: if weights are damaged, of another task or without their statistics.
        PluginError: if a plugin of the run cannot be imported.

    Examples:
        >>> from torchrl_koap.evaluation import load_run
        >>> trained = load_run("pretrained:avoiding")  # or the folder of a run of yours
        >>> trained.task.name, trained.planner.horizon
        ('avoiding', 14)
    """
    directory = RunDirectory(find_run(run))
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


def load_policy(
    run: str | Path | TrainedRun, *, device: str = "cpu", plugins: Sequence[str] = (), **asked: Any
) -> PlanningPolicy:
    """A run, or a file of :func:`~torchrl_koap.save_policy`, as a policy: observations in, an action per step out.

    A :class:`~torchrl_koap.modules.PolicyEnv` hands it what it reads; an :class:`~torchrl_koap.modules.Agent` keeps
    that itself.

    Args:
        run (str, Path or TrainedRun): a run directory, ``"pretrained:NAME"``, what :func:`load_run` made of one, or a
            file.

    Keyword Args:
        device (str): ``"cpu"`` or ``"cuda"``.
        plugins (sequence of str): modules that register task or method of a file, which cannot have them imported.
        **asked: fields of :class:`~torchrl_koap.modules.Execution`. What is not asked for is as ``koap eval`` has it,
            for a file as it was saved.

    Returns:
        PlanningPolicy: in evaluation mode, on the device asked for.

    Raises:
        ValueError: for an unknown strategy, or a number out of range.
        RunDirectoryError, CheckpointError, PluginError: as :func:`load_run`; a :class:`CheckpointError` names the file.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap import Agent, load_policy
        >>> agent = Agent(load_policy("pretrained:avoiding"), seed=0)
        >>> agent.reset()
        >>> agent.act(np.array([0.525, -0.28, 0.525, -0.28])).shape  # commanded and measured xy to a change of xy (m)
        (2,)
    """
    wanted = ExecutionConfig(**asked)
    if isinstance(run, (str, Path)) and Path(run).is_file():
        return read_policy(run, wanted, plugins=plugins).to(device)
    load_plugins(plugins)
    trained = run if isinstance(run, TrainedRun) else load_run(run)
    return trained_policy(trained, wanted).to(device)


def execution_of(trained: TrainedRun, asked: ExecutionConfig) -> Execution:
    """How a run's plans become actions: as asked for, else as the run, its method or its task has it.

    Args:
        trained (TrainedRun): the run.
        asked (ExecutionConfig): what is asked for.
    """
    if asked.candidates is None and (candidates := trained.config.get("candidates")):
        asked = replace(asked, candidates=candidates)
    return default_execution(trained.task, trained.method, asked)


def trained_policy(trained: TrainedRun, asked: ExecutionConfig) -> PlanningPolicy:
    """A run as a policy.

    Args:
        trained (TrainedRun): the run.
        asked (ExecutionConfig): how plans are to become actions.
    """
    execution, follower = execution_of(trained, asked), None
    if execution.strategy == "oracle":
        from torchrl_koap.evaluation.oracle import OracleFollower

        follower = OracleFollower(trained.task, blend=execution.blend)
    plugins = tuple(trained.config.get("plugins") or ())
    description = PolicyDescription(
        trained.task, trained.config["planner"], trained.config["controller"], trained.columns, plugins
    )
    return policy_of(trained.planner, trained.controller, description, execution, follower)
