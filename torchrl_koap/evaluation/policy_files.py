# This source code is licensed under the MIT license found in the LICENSE file.
"""A policy as one file: weights, statistics and how it is built, without its run directory or data.

The file is safetensors with a JSON header; reading one runs no code that it brings along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_koap.evaluation.rollouts import make_gain, make_leash, make_policy
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ChunkedPolicy, RecedingHorizonPolicy, StatePlanner
from torchrl_koap.modules.execution.plan_then_control import EXECUTIONS
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.weights import CheckpointError, check_weights, load_tensors, save_tensors
from torchrl_koap.tasks import REPLAN_INTERVAL, Task, get_task
from torchrl_koap.tasks.registry import plain_task
from torchrl_koap.training.builders import build_controller, method_named
from torchrl_koap.training.diffusion_builders import build_planner
from torchrl_koap.training.fit import Recipe
from torchrl_koap.training.method import Method
from torchrl_koap.training.provenance import versions

FORMAT, VERSION = "torchrl_koap policy", 1
BLEND_DECAY = 0.8
_OPTIONS = ("execution", "replan_interval", "blend_decay", "candidates", "command_lead", "action_gain")


@dataclass(frozen=True)
class PolicyDescription:
    """How a policy is built; kept as its attribute ``description`` by whatever builds one.

    Args:
        task (Task): the task.
        planner (dict): the ``planner`` entry of ``config.json``.
        controller (dict): its ``controller`` entry.
        columns (tuple of int): state columns that the controller reads.
        plugins (tuple of str): modules that register task or method.

    Examples:
        >>> from torchrl_koap.evaluation.policy_files import PolicyDescription
        >>> from torchrl_koap.tasks import get_task
        >>> PolicyDescription(get_task("avoiding"), planner={}, controller={}, columns=(0, 1)).task.name
        'avoiding'
    """

    task: Task
    planner: dict[str, Any]
    controller: dict[str, Any]
    columns: tuple[int, ...]
    plugins: tuple[str, ...] = ()


def build_networks(
    task: Task, method: Method, planner: dict[str, Any], controller: dict[str, Any]
) -> tuple[StatePlanner | None, nn.Module, tuple[int, ...]]:
    """The networks of a policy without weights, in evaluation mode.

    Args:
        task (Task): the task.
        method (Method): the method.
        planner (dict): the ``planner`` entry of ``config.json``.
        controller (dict): its ``controller`` entry.

    Returns:
        tuple: the planner, None for a policy of its own; the controller, or the policy; and the state columns that it
        reads.
    """
    columns = task.controller_columns(controller.get("state", "all"))
    if not method.has_planner:
        whole = method.build(task.state_dim, task.action_dim, task.planner_features(), planner)
        return None, whole.eval(), columns
    plans = build_planner(planner, task.state_dim, task.planner_features())
    acts = build_controller(controller, len(columns), task.action_dim, method=method)
    return plans.eval(), acts.eval(), columns


def assemble_policy(
    planner: StatePlanner | None,
    controller: nn.Module,
    description: PolicyDescription,
    *,
    execution: str = "feedback",
    replan_interval: int = REPLAN_INTERVAL,
    blend_decay: float = BLEND_DECAY,
    candidates: int = 1,
    command_lead: float = 0.0,
    action_gain: float = 1.0,
) -> RecedingHorizonPolicy:
    """Networks as a policy that knows how it was built.

    Args:
        planner (StatePlanner, optional): the planner, None for a policy of its own.
        controller (nn.Module): the controller, or the policy.
        description (PolicyDescription): how they were built.

    Keyword Args:
        execution (str): ``"feedback"`` or ``"open_loop"``; not looked at without a planner.
        replan_interval (int): control steps per plan.
        blend_decay (float): share of the distance between state and plan that is left after each step.
        candidates (int): plans, or action chunks, sampled whenever one is due.
        command_lead (float): farthest that the command may be ahead of the robot
            (:class:`~torchrl_koap.modules.CommandLeash`); 0: any distance.
        action_gain (float): what actions that are changes of a command are multiplied by.

    Raises:
        ValueError: for an unknown execution or rule, a number out of range, or a lead or gain in a task whose actions
            are no changes of a command (that it observes).
    """
    lookup(EXECUTIONS, execution, "execution")
    task = description.task
    if planner is None:
        policy = ChunkedPolicy(
            controller,
            state_columns=task.state_of,
            history=controller.history,
            replan_interval=replan_interval,
            candidates=candidates,
        )
    else:
        policy = make_policy(
            planner,
            controller,
            state_columns=task.state_of,
            execution=execution,
            replan_interval=replan_interval,
            blend_decay=blend_decay,
            controller_columns=description.columns,
            action_rule=task.action_rule,
            candidates=candidates,
        )
    policy.description = description
    policy.leash, policy.action_gain = make_leash(task, command_lead), make_gain(task, action_gain)
    return policy.eval()


def build_policy(planner: StatePlanner, controller: nn.Module, task: Task | None = None, **options: Any):
    """A fitted planner and controller as a policy: observations in, an action per control step out.

    Args:
        planner (StatePlanner): from :func:`~torchrl_koap.training.fit_planner`.
        controller (InverseDynamics): from :func:`~torchrl_koap.training.fit_controller`.
        task (Task, optional): the task. Default: the one they were fitted for.
        **options: ``execution``, ``replan_interval`` and ``blend_decay``, see
            :class:`~torchrl_koap.modules.PlanThenControl`. Default: the task's.

    Returns:
        PlanThenControl: for an :class:`~torchrl_koap.modules.Agent`, an environment with
        :func:`~torchrl_koap.modules.policy_transforms`, or :func:`save_policy`.

    Raises:
        TypeError: for networks that were not made by those functions.
        ValueError: if they were fitted for different tasks, or an option is out of range.

    Examples:
        >>> import numpy as np
        >>> import torchrl_koap
        >>> from torchrl_koap.data import make_demonstrations
        >>> states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(3)]
        >>> actions = [np.diff(states[0], axis=0), None, None]
        >>> data, task = make_demonstrations(states, actions, control_hz=30)
        >>> planner = torchrl_koap.fit_planner(data, task, steps=2, channels=(8, 16), progress=False)
        >>> controller = torchrl_koap.fit_controller(data, task, method="linear", progress=False)
        >>> policy = torchrl_koap.build_policy(planner, controller)
        >>> policy.history, policy.description.task is task
        (2, True)
    """
    made = {}
    for name, network in {"planner": planner, "controller": controller}.items():
        made[name] = getattr(network, "recipe", None)
        if not isinstance(made[name], Recipe):
            raise TypeError(f"the {name} must be one that fit_{name} returned; make_policy() takes any other")
    tasks = [recipe.task for recipe in made.values()]
    task = tasks[0] if task is None else task
    for name, recipe in made.items():
        if (recipe.task.state_names, recipe.task.action_names) != (task.state_names, task.action_names):
            raise ValueError(f"the {name} was fitted for other columns than those of task {task.name!r}")
    entries = {name: recipe.entry for name, recipe in made.items()}
    columns = task.controller_columns(entries["controller"]["state"])
    description = PolicyDescription(task, columns=columns, **entries)
    return assemble_policy(planner, controller, description, **dict(task.defaults.execution) | options)


def save_policy(policy: RecedingHorizonPolicy, path: str | Path) -> Path:
    """Writes a policy to one file, from which :func:`~torchrl_koap.load_policy` makes it again anywhere.

    Args:
        policy (PlanThenControl or ChunkedPolicy): from :func:`~torchrl_koap.load_policy` or :func:`build_policy`.
        path (str or Path): file to write, such as ``"policy.safetensors"``; replaced in one step.

    Returns:
        Path: the file.

    Raises:
        TypeError: for a policy that does not know how it was built.
        IsADirectoryError: if the path is a folder.

    Examples:
        >>> import tempfile
        >>> import torchrl_koap
        >>> from torchrl_koap.evaluation.policy_files import PolicyDescription, assemble_policy, build_networks
        >>> from torchrl_koap.modules import Normalizer
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.training import TrainConfig, resolve
        >>> entries = resolve(TrainConfig(out="", task="avoiding", method="linear", channels=(8, 16)))
        >>> networks = build_networks(get_task("avoiding"), entries.method, entries.planner, entries.controller)
        >>> description = PolicyDescription(get_task("avoiding"), entries.planner, entries.controller, networks[2])
        >>> policy = assemble_policy(*networks[:2], description)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = torchrl_koap.save_policy(policy, f"{folder}/policy.safetensors")
        ...     path.name
        'policy.safetensors'
    """
    path, made = Path(path), getattr(policy, "description", None)
    if not isinstance(made, PolicyDescription):
        raise TypeError(f"wanted a policy of load_policy() or build_policy(), got another {type(policy).__name__}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; a policy is one file, such as {path / 'policy.safetensors'}")
    planned = not isinstance(policy, ChunkedPolicy)
    networks = {"controller": policy.controller if planned else policy.planner}
    networks |= {"planner": policy.planner} if planned else {}
    tensors = {f"{name}.{key}": value for name, part in networks.items() for key, value in part.state_dict().items()}
    about = {
        "format": FORMAT,
        "version": VERSION,
        "task": made.task.name,
        "task_definition": None if made.task.import_strings() else made.task.to_json(),
        "planner": made.planner,
        "controller": made.controller,
        "columns": list(made.columns),
        "plugins": list(made.plugins),
        "replan_interval": policy.replan_interval,
        "candidates": policy.candidates,
        "versions": versions(),
    }
    if policy.leash is not None:
        about["command_lead"] = policy.leash.lead
    if policy.action_gain is not None:
        about["action_gain"] = _one_gain(policy.action_gain, made.task)
    if planned:
        about |= {"execution": policy.execution, "blend_decay": policy.blend_decay}
    save_tensors(path, tensors, about)
    return path


def _one_gain(gain: Tensor, task: Task) -> float:
    """The factor that all changes of a command have in common."""
    factor = float(gain[0])
    whole = torch.ones_like(gain)
    whole[list(task.delta_actions)] = factor
    if not torch.equal(gain, whole):
        raise ValueError(f"a file holds one action_gain for all changes of a command, the policy has {gain.tolist()}")
    return factor


def read_policy(path: str | Path, *, plugins: Sequence[str] = (), **options: Any) -> RecedingHorizonPolicy:
    """The policy that :func:`save_policy` wrote.

    Args:
        path (str or Path): the file.

    Keyword Args:
        plugins (sequence of str): modules that register its task or method; a file cannot have them imported itself.
        **options: ``execution``, ``replan_interval``, ``blend_decay`` instead of those it was saved with.

    Raises:
        CheckpointError: if the file is missing, damaged, no policy, or one of another version, or its weights do not
            fit; the message names it.
        PluginError: if a plugin cannot be imported.
    """
    load_plugins(plugins)
    tensors, about = load_tensors(path)
    if about.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no policy that save_policy() wrote")
    if about.get("version") != VERSION:
        raise CheckpointError(f"{path} is a policy of format {about.get('version')}, this version reads {VERSION}")
    try:
        description = _description(about)
        method = method_named(description.controller)
        planner, controller, columns = build_networks(
            description.task, method, description.planner, description.controller
        )
        if columns != description.columns:
            raise ValueError(f"its controller reads state columns {description.columns}, the task has {columns}")
        kept = {name: about[name] for name in _OPTIONS if name in about}
        policy = assemble_policy(planner, controller, description, **kept | options)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"entry {error} is missing" if isinstance(error, KeyError) else error
        needs = [name for name in about.get("plugins") or () if name not in plugins]
        hint = f"; it was made with the plugins {', '.join(map(str, needs))}" if needs else ""
        raise CheckpointError(f"{path} cannot be built: {problem}{hint}") from error
    for name, network in {"planner": planner, "controller": controller}.items():
        if network is not None:
            _load_part(path, name, network, tensors)
    return policy


def _description(about: dict[str, Any]) -> PolicyDescription:
    definition = about["task_definition"]
    return PolicyDescription(
        task=get_task(about["task"]) if definition is None else plain_task(definition),
        planner=dict(about["planner"]),
        controller=dict(about["controller"]),
        columns=tuple(about["columns"]),
        plugins=tuple(about.get("plugins", ())),
    )


def _load_part(path: str | Path, name: str, network: nn.Module, tensors: dict[str, Any]) -> None:
    own = {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}
    try:
        network.load_state_dict(own)
    except RuntimeError as error:
        problems = " ".join(str(error).split("\n", 1)[-1].split())
        raise CheckpointError(f"{path}: the weights do not fit the {name}: {problems}") from error
    check_weights(path, network)
