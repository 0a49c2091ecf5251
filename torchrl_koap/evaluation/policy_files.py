# This source code is licensed under the MIT license found in the LICENSE file.
"""A policy as one file: weights, statistics and how it is built, without its run directory or data.

The file is safetensors with a JSON header; reading one runs no code that it brings along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import nn

from torchrl_koap.modules import Execution, ExecutionConfig, Follower, PlanningPolicy, StatePlanner, make_policy
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.weights import CheckpointError, check_weights, load_tensors, save_tensors
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.tasks.registry import plain_task
from torchrl_koap.training.builders import build_controller, method_named
from torchrl_koap.training.diffusion_builders import build_planner
from torchrl_koap.training.fit import Recipe
from torchrl_koap.training.method import Method
from torchrl_koap.training.policy_facts import policy_facts
from torchrl_koap.training.provenance import versions

FORMAT, VERSION = "torchrl_koap policy", 1


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


def policy_of(
    planner: StatePlanner | None,
    controller: nn.Module,
    description: PolicyDescription,
    execution: Execution,
    follower: Follower | None = None,
) -> PlanningPolicy:
    """Networks as a policy that knows how it was built.

    Args:
        planner (StatePlanner, optional): the planner, None for a sampler of actions.
        controller (nn.Module): the controller, or the sampler.
        description (PolicyDescription): how they were built.
        execution (Execution): how plans become actions.
        follower (Follower, optional): follows plans in place of the controller.

    Raises:
        ValueError: as :func:`~torchrl_koap.modules.make_policy`.
    """
    gripper = description.controller.get("columns", {}).get("gripper")
    facts = policy_facts(description.task, columns=description.columns, gripper=gripper)
    networks = (controller,) if planner is None else (planner, controller)
    policy = make_policy(*networks, **facts, execution=execution, follower=follower)
    policy.description = description
    return policy


def default_execution(task: Task, method: Method, asked: ExecutionConfig) -> Execution:
    """How plans become actions: as asked for, else as the method, the task or the library has it.

    Args:
        task (Task): the task.
        method (Method): the method.
        asked (ExecutionConfig): what is asked for.

    Raises:
        ValueError: for another strategy than a sampler of actions has.
    """
    own = Execution().replaced(**task.defaults.execution).replaced(**method.execution)
    if not method.has_planner:
        if asked.strategy not in (None, "open_loop"):
            raise ValueError(
                f"strategy {asked.strategy!r} was asked of method {method.name!r}, which samples actions and executes"
                " chunks of them: there is no plan to follow"
            )
        own = own.replaced(strategy="open_loop")
    elif asked.strategy == "oracle":  # it knows how commands are answered
        own = own.replaced(gain=1.0)
    return asked.on(own)


def build_policy(
    planner: StatePlanner, controller: nn.Module, task: Task | None = None, **asked: Any
) -> PlanningPolicy:
    """A fitted planner and controller as a policy: observations in, an action per control step out.

    Args:
        planner (StatePlanner): from :func:`~torchrl_koap.training.fit_planner`.
        controller (nn.Module): from :func:`~torchrl_koap.training.fit_controller`.
        task (Task, optional): the task. Default: the one they were fitted for.
        **asked: fields of :class:`~torchrl_koap.modules.Execution`. Default: the method's, else the task's.

    Returns:
        PlanningPolicy: for an :class:`~torchrl_koap.modules.Agent`, a :class:`~torchrl_koap.modules.PolicyEnv`, or
        :func:`save_policy`.

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
    execution = default_execution(task, method_named(entries["controller"]), ExecutionConfig(**asked))
    return policy_of(planner, controller, description, execution)


def save_policy(policy: PlanningPolicy, path: str | Path) -> Path:
    """Writes a policy to one file, from which :func:`~torchrl_koap.load_policy` makes it again anywhere.

    Args:
        policy (PlanningPolicy): from :func:`~torchrl_koap.load_policy` or :func:`build_policy`.
        path (str or Path): file to write, such as ``"policy.safetensors"``; replaced in one step.

    Returns:
        Path: the file.

    Raises:
        TypeError: for a policy that does not know how it was built.
        IsADirectoryError: if the path is a folder.

    Examples:
        >>> import tempfile
        >>> import torchrl_koap
        >>> from torchrl_koap.evaluation.policy_files import PolicyDescription, build_networks, policy_of
        >>> from torchrl_koap.modules import Execution
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.training import TrainConfig, resolve
        >>> entries = resolve(TrainConfig(out="", task="avoiding", method="linear", channels=(8, 16)))
        >>> networks = build_networks(get_task("avoiding"), entries.method, entries.planner, entries.controller)
        >>> description = PolicyDescription(get_task("avoiding"), entries.planner, entries.controller, networks[2])
        >>> policy = policy_of(*networks[:2], description, Execution())
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
    networks = {"controller": policy.planner if policy.follower is None else policy.follower.controller}
    networks |= {} if policy.follower is None else {"planner": policy.planner}
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
        "execution": asdict(policy.execution),
        "versions": versions(),
    }
    save_tensors(path, tensors, about)
    return path


def read_policy(
    path: str | Path, asked: ExecutionConfig | None = None, *, plugins: Sequence[str] = ()
) -> PlanningPolicy:
    """The policy that :func:`save_policy` wrote.

    Args:
        path (str or Path): the file.
        asked (ExecutionConfig, optional): what is to be executed otherwise than it was saved.

    Keyword Args:
        plugins (sequence of str): modules that register its task or method; a file cannot have them imported itself.

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
        execution = Execution(**about["execution"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"entry {error} is missing" if isinstance(error, KeyError) else error
        needs = [name for name in about.get("plugins") or () if name not in plugins]
        hint = f"; it was made with the plugins {', '.join(map(str, needs))}" if needs else ""
        raise CheckpointError(f"{path} cannot be built: {problem}{hint}") from error
    for name, network in {"planner": planner, "controller": controller}.items():
        if network is not None:
            _load_part(path, name, network, tensors)
    return policy_of(planner, controller, description, execution if asked is None else asked.on(execution))


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
