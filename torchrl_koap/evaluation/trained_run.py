# This source code is licensed under the MIT license found in the LICENSE file.
"""A run directory as networks with their weights, and as a policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from torchrl_koap.data import LabelBudget
from torchrl_koap.evaluation.config import EvalConfig, check_ways
from torchrl_koap.evaluation.policy_files import (
    BLEND_DECAY,
    PolicyDescription,
    assemble_policy,
    build_networks,
    read_policy,
)
from torchrl_koap.evaluation.rollouts import make_gain, make_leash
from torchrl_koap.modules import RecedingHorizonPolicy, StatePlanner
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.runs.weights import CheckpointError, load_weights
from torchrl_koap.tasks import REPLAN_INTERVAL, Task, task_of
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
    def candidates(self) -> int:
        """Plans (of dp: action chunks) sampled whenever one is due, one of which is taken."""
        return self.config.get("candidates") or 1  # runs of before have none

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


def load_policy(run: str | Path | TrainedRun, config: EvalConfig | None = None) -> RecedingHorizonPolicy:
    """A run, or a file of :func:`~torchrl_koap.save_policy`, as a policy: observations in, an action per step out.

    An environment needs :func:`~torchrl_koap.modules.policy_transforms` of ``policy.history`` for it, which hand it the
    last observations; an :class:`~torchrl_koap.modules.Agent` keeps them itself.

    Args:
        run (str, Path or TrainedRun): a run directory, ``"pretrained:NAME"``, what :func:`load_run` made of one, or a
            file.
        config (EvalConfig, optional): execution, interval between plans, device and plugins; the rest is not
            used. What is not asked for is as ``koap eval`` has it, for a file as it was saved.

    Returns:
        RecedingHorizonPolicy: in evaluation mode, on the device asked for.

    Raises:
        ValueError: for an unknown execution, or an interval out of range.
        RunDirectoryError, CheckpointError, PluginError: as :func:`load_run`; a :class:`CheckpointError` names the file.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap import Agent, load_policy
        >>> agent = Agent(load_policy("pretrained:avoiding"), seed=0)
        >>> agent.reset()
        >>> agent.act(np.array([0.525, -0.28, 0.525, -0.28])).shape  # commanded and measured xy to a change of xy (m)
        (2,)
    """
    given, config = config, EvalConfig() if config is None else config
    check_ways(config)
    names = ("execution", "replan_interval", "blend_decay", "candidates", "command_lead", "action_gain")
    options = {name: getattr(config, name) for name in names if getattr(config, name) is not None}
    if config.controller == "oracle":
        trained = run if isinstance(run, TrainedRun) else load_run(run, task=config.task)
        policy = _oracle(trained, options | execution_of(trained, config))
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
        kept: dict[str, Any] = {"candidates": trained.candidates}
        policy = assemble_policy(
            trained.planner, trained.controller, description, **kept | options | execution_of(trained, config)
        )
    return policy.to(config.device)


def execution_of(trained: TrainedRun, config: EvalConfig) -> dict[str, Any]:
    """How plans are followed: as was asked for, else as the task has it, else in feedback.

    Args:
        trained (TrainedRun): the run.
        config (EvalConfig): what was asked for.
    """
    options: dict[str, Any] = {
        "execution": "feedback",
        "replan_interval": REPLAN_INTERVAL,
        "blend_decay": BLEND_DECAY,
        "command_lead": 0.0,
        "action_gain": 1.0,
    }
    own = dict(trained.task.defaults.execution)
    if trained.planner is None or config.controller == "oracle":  # chunks are executed as they are; an oracle looks
        own.pop("execution", None)
    knows = trained.method.tracks or trained.method.keeps_posture
    if config.controller == "oracle" or knows:  # they know what they commanded, and how it is answered
        own.pop("action_gain", None)
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

    kept = {"candidates": trained.candidates}
    history = max(trained.planner.history, getattr(trained.controller, "num_past", 0) + 1)
    rule = trained.task.action_rule if trained.task.gripper is not None else None
    leash = make_leash(trained.task, options.pop("command_lead"))
    gain = make_gain(trained.task, options.pop("action_gain"))
    policy = OracleControl(trained.planner, trained.task, history=history, action_rule=rule, **kept | options)
    policy.leash, policy.action_gain = leash, gain
    return policy
