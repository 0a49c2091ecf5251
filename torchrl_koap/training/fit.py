# This source code is licensed under the MIT license found in the LICENSE file.
"""The recipe of ``koap train`` in memory: demonstrations in, a trained planner or controller out.

Normalisers, scales, losses, augmentation, averaged weights and the closed form at the end are those of ``koap train``:
with the same data, seed and settings the weights are the same bit for bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data import mark_labels, select_state
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import InverseDynamics, StatePlanner
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.progress import without_progress_bars
from torchrl_koap.tasks import Action, Task
from torchrl_koap.training.controller import learn_actions
from torchrl_koap.training.diffusion_builders import build_planner
from torchrl_koap.training.planner import learn_states
from torchrl_koap.training.resolved import ResolvedConfig, resolve

PLANNER_OPTIONS = (
    *("batch_size", "planner_learning_rate", "denoiser", "denoiser_width", "channels", "observed_frames", "precision"),
)
CONTROLLER_OPTIONS = (
    *("controller_batch_size", "controller_learning_rate", "preset", "decoder", "controller_state"),
    *("koopman_coeff", "action_coeff"),
)


@dataclass(frozen=True)
class Recipe:
    """What a fitted planner or controller was made by; kept as its attribute ``recipe``.

    Args:
        task (Task): the task of its data.
        entry (dict): what builds it again, as ``config.json`` of a run holds it.
        results (dict): last losses and, for a closed form, penalty, number of labels and held-out error.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.training.fit import Recipe
        >>> Recipe(get_task("avoiding"), {"method": "linear"}).results
        {}
    """

    task: Task
    entry: dict[str, Any]
    results: Mapping[str, Any] = field(default_factory=dict)


def fit_planner(
    data: TensorDictBase,
    task: Task | None = None,
    *,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: bool = True,
    **options: Any,
) -> StatePlanner:
    """Trains a planner of states; it looks at no action.

    Args:
        data (TensorDictBase): flat data ``[N]`` (:func:`~torchrl_koap.data.make_demonstrations`, or a data set of D3IL
            or LeRobot). Without ``state``, the columns that the task names are taken from ``observation``.
        task (Task, optional): the task, as ``make_demonstrations`` returns it. Default: all columns of ``state`` (of
            ``observation`` where there is none) are the robot's.

    Keyword Args:
        steps (int, optional): updates. Default: ``task.defaults.planner_steps``.
        seed (int): seed of initialisation and batches; torch's generators are left as they were.
        device (str): ``"cpu"`` or ``"cuda"``.
        progress (bool): show a progress bar.
        **options: further options of :class:`~torchrl_koap.training.TrainConfig` that concern the planner:
            ``batch_size``, ``planner_learning_rate``, ``denoiser``, ``denoiser_width``, ``channels``,
            ``observed_frames``, ``precision``.

    Returns:
        StatePlanner: in evaluation mode, with statistics and a :class:`Recipe` as ``recipe``.

    Raises:
        ValueError: for an unknown option, data that do not fit the task, or trajectories shorter than a window.
        LayoutError: if the data do not follow the storage layout.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_demonstrations
        >>> from torchrl_koap.training import fit_planner
        >>> states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(3)]
        >>> data, task = make_demonstrations(states, control_hz=30, action_dim=2)
        >>> planner = fit_planner(data, task, steps=2, channels=(8, 16), progress=False)
        >>> planner.sample(data["observation"][None, :2]).shape
        torch.Size([1, 14, 2])
    """
    data, task = _prepared(data, task, action_dim=1)  # no action is looked at
    _check_options(options, PLANNER_OPTIONS, "fit_planner")
    resolved = _resolved(task, steps=steps, seed=seed, device=device, **options)
    data = data.to(device)
    with _seeded(seed, device, progress):
        planner = build_planner(resolved.planner, task.state_dim, task.planner_features()).to(device)
        losses = learn_states(planner, data, task, resolved.options)
    planner.recipe = Recipe(task, resolved.planner, losses)
    return planner.eval()


def fit_controller(
    data: TensorDictBase,
    task: Task | None = None,
    *,
    method: str | None = None,
    steps: int = 500,
    seed: int = 0,
    device: str = "cpu",
    progress: bool = True,
    **options: Any,
) -> InverseDynamics:
    """Trains a controller, which turns states into actions, on all steps and the few labels among them.

    From recorded arrays to an action on the robot::

        data, task = make_demonstrations(states, actions, control_hz=30, robot=range(7))
        planner = torchrl_koap.fit_planner(data, task)
        controller = torchrl_koap.fit_controller(data, task)
        policy = torchrl_koap.build_policy(planner, controller)
        torchrl_koap.save_policy(policy, "policy.safetensors")
        agent = torchrl_koap.Agent(policy)
        agent.reset()
        action = agent.act(observation)

    Args:
        data (TensorDictBase): as for :func:`fit_planner`. ``has_action`` says which actions may be seen; without it,
            those that are not NaN. A :class:`~torchrl_koap.data.LabelBudget` takes labels away.
        task (Task, optional): as for :func:`fit_planner`.

    Keyword Args:
        method (str): a name in :data:`~torchrl_koap.training.METHODS` of a controller, such as ``"koap"``,
            ``"linear"`` (ridge on raw frames) or ``"dd"`` (supervised). Default: the task's, mostly ``"koap"``.
        steps (int): updates; with 0 only the closed form is fitted, if the method has one.
        seed (int): as for :func:`fit_planner`.
        device (str): likewise.
        progress (bool): likewise.
        **options: further options of :class:`~torchrl_koap.training.TrainConfig` that concern the controller:
            ``controller_batch_size``, ``controller_learning_rate``, ``preset``, ``decoder``, ``controller_state``,
            ``koopman_coeff``, ``action_coeff``.

    Returns:
        InverseDynamics: in evaluation mode, with a :class:`Recipe` as ``recipe``. It reads
        ``task.controller_columns(controller_state)`` of the state, by default the robot's own.

    Raises:
        ValueError: for an unknown method or option, a method that is a policy of its own, data without any label or
            that do not fit the task, or trajectories shorter than a window.
        LayoutError: if the data do not follow the storage layout.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_demonstrations
        >>> from torchrl_koap.training import fit_controller
        >>> states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(3)]
        >>> actions = [np.diff(states[0], axis=0), None, None]
        >>> data, task = make_demonstrations(states, actions, control_hz=30)
        >>> controller = fit_controller(data, task, method="linear", progress=False)
        >>> int(data["has_action"].sum()), controller.recipe.results["labels_used"]
        (39, 31)
    """
    data, task = _prepared(data, task)
    _check_options(options, CONTROLLER_OPTIONS, "fit_controller")
    resolved = _resolved(
        task, method=method, steps=max(steps, 1), controller_steps=steps, seed=seed, device=device, **options
    )
    if not resolved.method.has_planner:
        name = resolved.method.name
        raise ValueError(f"method {name!r} is a policy of its own, no controller: train it with `koap train`")
    if not data[keys.HAS_ACTION].any():
        raise ValueError(f"none of the {len(data)} steps has an action: there are no labels to learn from")
    data = data.to(device)
    with _seeded(seed, device, progress):
        controller, fit, losses = learn_actions(resolved, data)
    controller.recipe = Recipe(task, resolved.controller, losses | fit)
    return controller.eval()


def _prepared(data: TensorDictBase, task: Task | None, *, action_dim: int | None = None) -> tuple[TensorDictBase, Task]:
    """The data with labels marked and ``state``, and the task they are of."""
    if keys.ACTION not in data.keys() or keys.HAS_ACTION not in data.keys():
        data = mark_labels(data, action_dim=action_dim if task is None else task.action_dim)
    task = _task_of_columns(data) if task is None else task
    keys.validate(data, command=task.command_columns)
    if keys.STATE not in data.keys():
        data = select_state(data, task.state_of)
    for key, wanted in {keys.STATE: task.state_dim, keys.ACTION: task.action_dim}.items():
        if data[key].shape[-1] != wanted:
            raise ValueError(f"{key!r} has {data[key].shape[-1]} columns, task {task.name!r} has {wanted}")
    networks = torch.get_default_dtype()
    wide = {key: data[key].to(networks) for key in (keys.STATE, keys.ACTION) if data[key].dtype != networks}
    return (data.copy().update(wide) if wide else data), task


def _task_of_columns(data: TensorDictBase) -> Task:
    """A task about which nothing is known but the number of columns."""
    seen = data.get(keys.STATE, None)
    width = (data[keys.OBSERVATION] if seen is None else seen).shape[-1]
    actions = {f"action_{column}": Action() for column in range(data[keys.ACTION].shape[-1])}
    return Task(name="robot", observation_parts={"robot": width}, actions=actions, position="robot")


def _resolved(task: Task, **options: Any) -> ResolvedConfig:
    return resolve(TrainConfig(out=Path(), **options), task)


def _check_options(options: Mapping[str, Any], known: Sequence[str], function: str) -> None:
    for name in options:
        lookup(known, name, f"option of {function}")


@contextlib.contextmanager
def _seeded(seed: int, device: str, progress: bool) -> Iterator[None]:
    """Draws from a seed of its own, with or without bars."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(torch.random.fork_rng(devices=None if device != "cpu" else []))
        if not progress:
            stack.enter_context(without_progress_bars())
        torch.manual_seed(seed)
        yield
