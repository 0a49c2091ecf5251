# This source code is licensed under the MIT license found in the LICENSE file.
"""Trains in memory as ``koap train`` does: demonstrations in, trained networks out.

Normalisers, scales, losses, augmentation, averaged weights and the final closed form are those of ``koap train``: the
same data, seed and options give the same weights, bit for bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data import select_state
from torchrl_koap.data.trajectories import mark_labels
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import StatePlanner
from torchrl_koap.runs.config import ControllerConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.runs.device import set_up_torch, torch_as_before
from torchrl_koap.runs.progress import without_progress_bars
from torchrl_koap.tasks import Action, Task
from torchrl_koap.training.controller import check_lengths, learn_controller
from torchrl_koap.training.datasets import choose_held_out, split_held_out, within_budget
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.loop import Phases
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import sizes_of
from torchrl_koap.training.planner import learn_planner
from torchrl_koap.training.trained import Trained


def fit(
    data: TensorDictBase,
    task: Task | None = None,
    *,
    method: str | None = None,
    planner: StatePlanner | Mapping[str, Any] | Literal[False] | None = None,
    controller: Mapping[str, Any] | None = None,
    seed: int = 0,
    device: str = "cpu",
    precision: str = "auto",
    progress: bool = True,
) -> Trained:
    """Trains planner and controller, or a network that samples actions, on data in memory.

    From recorded arrays to an action for the robot::

        data, task = make_demonstrations(states, actions, control_hz=30, robot=range(7))
        trained = torchrl_koap.fit(data, task)
        trained.save("policy.safetensors")
        agent = torchrl_koap.Agent(trained.policy())
        agent.reset()
        action = agent.act(observation)

    Args:
        data (TensorDictBase): flat data ``[N]`` (:func:`~torchrl_koap.data.make_demonstrations`, or a data set of D3IL
            or LeRobot). Without ``state``, the columns that the task names are taken from ``observation``.
            ``has_action`` marks the actions that may be seen; without it, those that are not NaN. A
            :class:`~torchrl_koap.data.LabelBudget` hides labels. As in ``koap train``, commands of trajectories with a
            hidden action are hidden.
        task (Task, optional): the task, as ``make_demonstrations`` returns it. Default: all columns of ``state`` (or
            ``observation``, if there is no state) are the robot's.

    Keyword Args:
        method (str, optional): a name in :data:`~torchrl_koap.training.METHODS`. Default: the task's,
            ``"koap"`` unless it names another.
        planner (StatePlanner or mapping, optional): a planner to share instead of training one, or options of
            :class:`~torchrl_koap.PlannerConfig` such as ``{"steps": 5000}``; False trains a controller alone. Default:
            the task's options.
        controller (mapping, optional): options of :class:`~torchrl_koap.ControllerConfig`.
        seed (int): seed of initialisation and batches. Training takes one thread unless ``OMP_NUM_THREADS`` is set;
            torch's generators and threads are restored afterwards.
        device (str): ``"cpu"`` or ``"cuda"``.
        precision (str): number type of the planner's matrix products, see :class:`~torchrl_koap.RunConfig`.
        progress (bool): show progress bars.

    Returns:
        Trained: its networks are in evaluation mode.

    Raises:
        ValueError: for an unknown method or option, data without labels or that do not fit the task, or trajectories
            shorter than a window.
        DataError: if the data do not follow the storage layout.
        TypeError: if the data are no TensorDict.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap import fit
        >>> from torchrl_koap.data import make_demonstrations
        >>> states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(3)]
        >>> actions = [np.diff(states[0], axis=0), None, None]
        >>> data, task = make_demonstrations(states, actions, control_hz=30)
        >>> trained = fit(data, task, planner={"steps": 2, "width": 8}, controller={"steps": 2}, progress=False)
        >>> task.defaults.planner  # chosen for these data
        {'frames': 1, 'steps': 3000}
        >>> trained.planner.sample(data["observation"][None, :1]).shape
        torch.Size([1, 14, 2])
        >>> other = fit(data, task, method="linear", planner=trained.planner, progress=False)
        >>> other.planner is trained.planner, other.results["decoder_fit"]["labels_used"]
        (True, 31)
    """
    if not isinstance(data, TensorDictBase):
        wanted = "the data of make_demonstrations(), the first of the two that it returns"
        raise TypeError(f"data must be {wanted}, got {type(data).__name__}")
    device = str(device)
    data, task = _prepared(data, task)
    shared = planner if isinstance(planner, StatePlanner) else None
    if shared is not None and shared.state_dim != task.state_dim:
        raise ValueError(f"planner: it plans {shared.state_dim} columns, states of the data have {task.state_dim}")
    if shared is None and not (planner is None or planner is False or isinstance(planner, Mapping)):
        raise ValueError(
            f"planner must be a StatePlanner, a mapping of options, None or False, got {type(planner).__name__}"
        )
    set_up_torch(None, device)
    # a given planner may have seen all trajectories, so none counts as held out
    given = {"held_out": 0.0} | ({} if shared is None else sizes_of(shared))
    options = given if shared is not None or planner is False else dict(planner or {})
    config = resolve(
        TrainConfig(
            out=Path(),
            method=method,
            planner=_section(PlannerConfig, options),
            controller=_section(ControllerConfig, controller or {}),
            run=RunConfig(seed=seed, device=device, precision=precision),
        ),
        task,
    )
    seed = config.run.seed
    data, _ = within_budget(task, config, data)  # keeps all labels; hides commands whose changes are not labels
    held_out = choose_held_out(data, config.planner.held_out, seed=seed)
    check_lengths(task, config, data)
    seen, unseen, data = split_held_out(data.to(device), held_out)
    results = dict[str, Any]()
    plans = get_method(config.method).plans
    if shared is not None and not plans:
        raise ValueError(f"planner: method {config.method!r} samples actions and has no planner")
    bars = contextlib.nullcontext() if progress else without_progress_bars()
    with torch_as_before(), bars:
        set_up_torch(config.run.threads, device)
        torch.manual_seed(seed)
        if plans and shared is None and planner is not False:
            shared, results["planner"] = learn_planner(task, config, seen, Phases(), held_out=unseen)
        torch.manual_seed(seed)
        module, found = learn_controller(task, config, data, Phases())
    return Trained(
        task, config, None if shared is None else shared.eval(), module.eval(), results | found, tuple(held_out)
    )


def _section(kind: type, options: Mapping[str, Any]) -> Any:
    for name in options:
        lookup([field.name for field in fields(kind)], name, f"option of {kind.__name__}")
    return kind(**options)


def _prepared(data: TensorDictBase, task: Task | None) -> tuple[TensorDictBase, Task]:
    """Returns the data with labels marked and with ``state``, and their task."""
    if keys.ACTION not in data.keys() or keys.HAS_ACTION not in data.keys():
        data = mark_labels(data, action_dim=None if task is None else task.action_dim)
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
    """Returns a task of which only the number of columns is known."""
    seen = data.get(keys.STATE, None)
    width = (data[keys.OBSERVATION] if seen is None else seen).shape[-1]
    actions = {f"action_{column}": Action() for column in range(data[keys.ACTION].shape[-1])}
    return Task(name="robot", observation_parts={"robot": width}, actions=actions, position="robot")
