# This source code is licensed under the MIT license found in the LICENSE file.
"""The part of a training that uses labels: a controller, or a network that samples actions."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn

from torchrl_koap.data import cut_windows, make_window_buffer
from torchrl_koap.data.trajectories import extrapolate_ends, labelled_episodes, trajectory_lengths
from torchrl_koap.data.windows import WindowTable, spread_evenly
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, STATE
from torchrl_koap.modules import InverseDynamics
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.device import DTYPES
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.tasks import HORIZON, WINDOW, Task
from torchrl_koap.tasks.action_rules import shift_actions
from torchrl_koap.training.closed_form import UnusableLabelsError, action_facts, fit_closed_form
from torchrl_koap.training.loop import Phases
from torchrl_koap.training.method import BATCHES, Method
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_controller
from torchrl_koap.training.planner import augmentation, planned_windows
from torchrl_koap.training.policy_facts import command_ranges, controller_data, state_reader, with_commands

LEARNING_RATE = 1e-3
FEW_VALUES = 5  # an action with more distinct values is neither a switch nor a mode
FITTED = 50_000  # windows at most that statistics without labels are fitted to
_BATCH = 4096  # windows per forward pass in relabelling
_KEYS = [STATE, ACTION, HAS_ACTION]


def learn_controller(
    task: Task, config: TrainConfig, data: TensorDictBase, loop: Phases
) -> tuple[nn.Module, dict[str, Any]]:
    """Builds and trains the network that gives actions, from flat data ``[N]`` after the label budget was applied.

    Returns the network, and for the summary: the last losses ``controller``, ``controller_updates``, the result
    ``decoder_fit`` of a closed form, and the ``command_ranges``.
    """
    method, before = get_method(config.method), loop.updates
    ranges = command_ranges(task, data)  # of recorded labels, not of a teacher's actions
    data = data if method.fit is not None else with_commands(task, data)
    if method.teacher:
        data = _relabelled(task, config, get_method(method.teacher), data, loop)
    fit, losses = dict[str, Any](), dict[str, float]()
    if method.fit is not None:
        module = build_controller(task, method, config.controller).to(config.run.device)
        fit = method.fit(module, data, config.controller.steps)
    elif method.plans:
        module, fit, losses = _train_network(task, config, method, data, loop)
    else:
        module, losses = _train_sampler(task, config, method, data, loop)
    return module, {
        "controller": losses,
        "controller_updates": loop.updates - before,
        "decoder_fit": fit,
        "command_ranges": ranges,
    }


def check_lengths(task: Task, config: TrainConfig, data: TensorDictBase) -> None:
    """Raises a ValueError before training if a trajectory of flat data ``[N]`` is shorter than a window.

    Also if a controller fails, its actions lack the task's width, or no label is early enough for it. Warns of late
    switches that no fit sees.
    """
    method = get_method(config.method)
    if not method.plans or method.fit is not None:
        WindowTable.build(data, WINDOW, pad_before=1)
        return
    with torch.random.fork_rng(devices=[]):
        controller = build_controller(task, method, config.controller)
        if not isinstance(controller, InverseDynamics):
            raise ValueError(f"method {config.method!r}: build gave {controller!r}, wanted an InverseDynamics")
        if method.closed_form and type(controller).fit_labels is InverseDynamics.fit_labels:
            raise ValueError(f"method {config.method!r}: closed_form needs fit_labels(), which its controller lacks")
        controller.eval()
        shortest, past = controller.num_window_frames, controller.num_past
        window = max(WINDOW, shortest)
        _check_actions(task, config, controller, window)
    WindowTable.build(data, window, pad_before=past)
    counted = range(past, past + 1) if method.closed_form else controller.valid_frames(shortest)
    if not WindowTable.build(data, shortest, counted=counted, pad_before=past).labelled.any():
        raise UnusableLabelsError(
            f"no label is followed by the {shortest - counted.stop} recorded steps that method {config.method!r} needs:"
            " label earlier steps"
        )
    _warn_of_late_switches(task, data, window - controller.valid_frames(window).stop)


def _check_actions(task: Task, config: TrainConfig, controller: nn.Module, window: int) -> None:
    """Runs a controller once on a window of zeros; raises a ValueError if it fails or gives another shape."""
    states = torch.zeros(1, window, state_reader(task, config.controller).width)
    batch, frames = TensorDict({controller.in_key: states}, [1]), controller.valid_frames(window)
    calls = {  # in normalised units first: denormalising would broadcast a width of 1
        "gave": (lambda: controller.predict(states), window),
        f"gave for the frames {frames}": (lambda: controller.predict(states, frames), len(frames)),
        "gave as a module": (lambda: controller(batch)[controller.out_key], window),
    }
    for how, (call, count) in calls.items():
        try:
            with torch.no_grad():
                given = list(call().shape)
        except Exception as error:
            said = f"its network failed on a window of states {list(states.shape)}: {type(error).__name__}: {error}"
            raise ValueError(f"method {config.method!r}: {said}") from error
        if given != (wanted := [1, count, task.action_dim]):
            raise ValueError(f"method {config.method!r}: its network {how} {given}, wanted {wanted}")


def _warn_of_late_switches(task: Task, data: TensorDictBase, ahead: int) -> None:
    """Warns of raw actions with few values that change in the last steps, to which no controller is fitted."""
    parts = [part for part in data.split(trajectory_lengths(data).tolist()) if part[HAS_ACTION].all()]
    if not parts:
        return
    tails = torch.stack([part[ACTION][-ahead - 1 :] for part in parts])
    changes = (tails != tails[:, :1]).any(1).sum(0).tolist()
    labels = torch.cat([part[ACTION] for part in parts])
    for (name, action), column, count in zip(task.actions.items(), labels.T, changes, strict=True):
        if action.kind == "raw" and 2 * count > len(parts) and len(column.unique()) <= FEW_VALUES:
            warnings.warn(
                f"action {name!r} changes in the last {ahead} steps of {count} of {len(parts)} labelled recordings."
                f" No controller is fitted to these steps, as it looks ahead: record {ahead} frames more",
                stacklevel=4,
            )


def _train_network(
    task: Task, config: TrainConfig, method: Method, data: TensorDictBase, loop: Phases
) -> tuple[nn.Module, dict[str, Any], dict[str, float]]:
    """Trains a controller in its phases, then fits its closed form if it has one."""
    data, budget = controller_data(task, config.controller, data), config.controller.steps
    controller = build_controller(task, method, config.controller, data).to(config.run.device)
    history, shortest = controller.num_past, controller.num_window_frames
    window = max(WINDOW, shortest)
    everything = method.sees == "all"
    windows = cut_windows(data, window, select=_KEYS, pad_before=history, most=FITTED if everything else None)
    if not everything:
        windows = spread_evenly(windows[windows[HAS_ACTION].any(dim=(1, 2))], FITTED)
    states, losses = windows[STATE], dict[str, float]()
    with progress_bar(None, "lifting", delay=0.5, mininterval=0.5) as bar:  # most controllers prepare nothing
        controller.prepare(states, updates=budget if method.phases else 0, progress=count_up_to(bar))
    phases = method.phases_by_preset.get(config.controller.preset, method.phases)
    for phase in phases if budget else ():
        batch = BATCHES[phase.windows]
        buffer = make_window_buffer(
            data,
            shortest if batch.shortest else window,
            batch.size,
            select=_KEYS,
            labelled_share=batch.labelled_share,
            counted=controller.valid_frames(shortest) if batch.shortest else None,
            pad_before=history,
        )
        losses |= loop(
            phase.name,
            phase.loss(controller),
            buffer.sample,
            num_steps=max(round(budget * phase.share), 1),
            learning_rate=LEARNING_RATE,
            weight_decay=1e-3,
        )
    controller.eval()
    controller.finish(states)
    if not method.closed_form:
        return controller, {}, losses
    facts = action_facts(task, task.controller_columns(config.controller.columns))
    return controller, fit_closed_form(controller, data, **facts), losses


def _train_sampler(
    task: Task, config: TrainConfig, method: Method, data: TensorDictBase, loop: Phases
) -> tuple[nn.Module, dict[str, float]]:
    """Trains a network that samples actions, with the updates that a planner would have."""
    (phase,) = method.phases
    section = config.planner
    sampler = method.build(task, section).to(config.run.device)
    _, states = planned_windows(data[torch.isin(data[EPISODE], labelled_episodes(data))])
    sampler.fit_normalizers(states, data[ACTION][data[HAS_ACTION].squeeze(-1)])
    # at the end of a demonstration only recorded steps count
    buffer = make_window_buffer(
        data,
        WINDOW,
        section.batch_size,
        select=_KEYS,
        pad_before=1,
        pad_after=HORIZON - 1,
        labelled_share=BATCHES[phase.windows].labelled_share,
    )
    loss = phase.loss(sampler, dtype=DTYPES[config.run.precision])
    augment = augmentation(task, states, actions=True)
    section = replace(section, steps=max(round(section.steps * phase.share), 1))
    losses = loop.denoise(phase.name, loss, lambda: augment(buffer.sample()), section)
    loss.target_network_params.to_module(sampler)
    return sampler, losses


def _relabelled(task: Task, config: TrainConfig, teacher: Method, data: TensorDictBase, loop: Phases) -> TensorDictBase:
    """Trains the teacher and returns the data with its actions where there is no label."""
    phases = tuple(replace(phase, name=f"teacher_{phase.name}") for phase in teacher.phases)
    controller, _, _ = _train_network(task, config, replace(teacher, phases=phases), data, loop)
    view = controller_data(task, config.controller, data)
    labelled = relabel(controller, view, window=max(WINDOW, controller.num_window_frames))
    if task.distances:
        labelled[ACTION] = shift_actions(labelled[ACTION], data[STATE], task.distances)
    return data.copy().update(labelled.select(ACTION, HAS_ACTION))


@torch.no_grad()
def relabel(controller: InverseDynamics, data: TensorDictBase, *, window: int) -> TensorDictBase:
    """Gives every unlabelled step the action that a controller in evaluation mode infers from recorded states.

    The action is that of frame ``controller.num_past`` of a window. Beyond the ends of a trajectory, the first state
    is repeated and the last ones continue at their velocity (:func:`~torchrl_koap.data.extrapolate_ends`)::

        frame            0      1      2      ...    window - 1         (history = 1)
        action of step 0 x_0    x_0    x_1    ...
        action of step t x_t-1  x_t    x_t+1  ...

    Flat data ``[N]`` have ``state`` as the controller sees it, and are not changed. Returns a shallow copy in which
    every step has an action; labelled steps keep theirs bit for bit.
    """
    hidden, now = ~data[HAS_ACTION].squeeze(-1), controller.num_past
    action = data[ACTION].clone()
    continued = extrapolate_ends(data, window - 1 - now)
    # one window per hidden step, with the step at frame `now`, in the order of the data
    frames, _ = WindowTable.build(continued, window, counted=range(now, window - 1), pad_before=now).frames(hidden)
    rows = hidden.nonzero().squeeze(-1)
    for first in range(0, len(rows), _BATCH):
        part = slice(first, first + _BATCH)
        windows = TensorDict({controller.in_key: continued[STATE][frames[part]]}, frames[part].shape)
        action[rows[part]] = controller(windows)[controller.out_key][:, now]
    return data.copy().update({ACTION: action, HAS_ACTION: torch.ones_like(data[HAS_ACTION])})
