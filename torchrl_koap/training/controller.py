# This source code is licensed under the MIT license found in the LICENSE file.
"""The part of a training that spends labels: a controller, or a policy of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn

from torchrl_koap.data import cut_windows, extrapolate_ends, make_window_buffer
from torchrl_koap.data.pseudo_labels import relabel
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.device import training_dtype
from torchrl_koap.runs.progress import progress_bar, show_losses
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import save_tensors, save_weights
from torchrl_koap.tasks import HORIZON, WINDOW
from torchrl_koap.training.builders import build_controller
from torchrl_koap.training.closed_form import axes_of, fit_closed_form
from torchrl_koap.training.loop import moving_average, train_phase
from torchrl_koap.training.method import LABELLED_SHARES, Method, Phase
from torchrl_koap.training.planner import WEIGHT_DECAY, augmentation
from torchrl_koap.training.resolved import ResolvedConfig

_KEYS = ["state", "action", "has_action"]


def train_controller(
    run: RunDirectory, resolved: ResolvedConfig, data: TensorDictBase, logger: Any = None
) -> tuple[nn.Module, dict[str, Any], dict[str, float]]:
    """Trains what turns states into actions and writes its weights.

    Args:
        run (RunDirectory): where weights, metrics and checkpoints go.
        resolved (ResolvedConfig): all options.
        data (TensorDictBase): flat data after the label budget was applied, with the whole ``state``.
        logger (optional): a TorchRL logger.

    Returns:
        tuple: the module, what was found by a closed form (empty if there is none), and the last losses.
    """
    controller, fit, values = learn_actions(resolved, data, run=run, logger=logger)
    about = {"task": resolved.task.name, "kind": "controller"}
    save_weights(run.path / "controller.safetensors", controller, about)
    if isinstance(controller, KoopmanInverseDynamics):
        eigenvalues = controller.operator.eigenvalues()
        save_tensors(run.path / "eigenvalues.safetensors", {"real": eigenvalues.real, "imag": eigenvalues.imag})
    return controller, fit, values


def learn_actions(
    resolved: ResolvedConfig, data: TensorDictBase, *, run: RunDirectory | None = None, logger: Any = None
) -> tuple[nn.Module, dict[str, Any], dict[str, float]]:
    """Builds and trains what turns states into actions, without writing it.

    Args:
        resolved (ResolvedConfig): all options.
        data (TensorDictBase): flat data after the label budget was applied, with the whole ``state``.

    Keyword Args:
        run (RunDirectory, optional): where metrics and checkpoints go. Default: nowhere.
        logger (optional): a TorchRL logger.

    Returns:
        tuple: as :func:`train_controller`.
    """
    method = resolved.method
    train_one = _Training(run, resolved, logger)
    fit: dict[str, Any] = {}
    if resolved.teacher is not None:
        data = _relabelled(train_one, resolved, data)
    if method.fit is not None:
        columns, width = data["state"].shape[-1], resolved.task.action_dim
        controller = build_controller(resolved.controller, columns, width, method=method).to(resolved.options.device)
        fit, values = method.fit(controller, data, train_one.controller_budget), dict[str, float]()
    elif method.has_planner:
        view = resolved.controller_view(data)
        controller, fit, values = _train_network(train_one, method, resolved.controller, view)
    else:
        controller, values = _train_policy(train_one, resolved, data)
    values["updates"] = train_one.updates
    return controller, fit, values


class _Training:
    """Runs phases with the options of a run."""

    def __init__(self, run: RunDirectory | None, resolved: ResolvedConfig, logger: Any):
        self.run, self.options, self.logger, self.task = run, resolved.options, logger, resolved.task
        self.controller_budget = min(self.options.controller_steps, self.options.steps)
        self.updates = 0

    def __call__(self, name: str, loss: nn.Module, sample: Callable, *, num_steps: int, **settings) -> dict[str, float]:
        self.updates += num_steps
        with progress_bar(num_steps, name, smoothing=0.05, mininterval=0.5) as bar:
            return train_phase(
                name,
                loss,
                sample,
                num_steps=num_steps,
                run=self.run,
                logger=self.logger,
                checkpoint_every=self.options.checkpoint_every,
                resume=self.options.resume,
                progress=show_losses(bar),
                **settings,
            )


def _train_network(
    train_one: _Training, method: Method, entry: dict[str, Any], data: TensorDictBase
) -> tuple[nn.Module, dict[str, Any], dict[str, float]]:
    """A controller's phases, and its closed form if it has one."""
    options, task = train_one.options, train_one.task
    controller = build_controller(entry, data["state"].shape[-1], task.action_dim, data, method=method)
    controller = controller.to(options.device)
    history = controller.num_past
    window = max(WINDOW, controller.num_window_frames)
    windows = cut_windows(data, window, select=["state", "has_action"], pad_before=history)
    if method.labelled_only:
        windows = windows[windows["has_action"].squeeze(-1).any(-1)]
    budget = train_one.controller_budget
    with progress_bar(None, "lifting", delay=0.5, mininterval=0.5) as bar:  # most have nothing to train before

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        controller.prepare(windows["state"], updates=budget if method.phases else 0, progress=progress)
    values: dict[str, float] = {}
    for phase in method.phases if budget else ():
        buffer = make_window_buffer(
            data,
            window,
            options.controller_batch_size,
            select=_KEYS,
            pad_before=history,
            labelled_share=LABELLED_SHARES[phase.windows],
        )
        values |= train_one(
            phase.name,
            phase.loss(controller, **_coefficients(options, phase)),
            buffer.sample,
            num_steps=max(round(budget * phase.share), 1),
            learning_rate=options.controller_learning_rate,
            weight_decay=1e-3,
        )
    controller.eval()
    fit: dict[str, Any] = {}
    controller.finish(windows["state"])
    if method.closed_form:
        fit = fit_closed_form(controller, data, **axes_of(task, task.controller_columns(options.controller_state)))
    return controller, fit, values


def _coefficients(options: TrainConfig, phase: Phase) -> dict[str, float]:
    """The coefficients that were asked for, of those that the loss of a phase takes."""
    asked = {"koopman_coeff": options.koopman_coeff, "action_coeff": options.action_coeff}
    return {name: asked[name] for name in phase.coefficients if asked[name] is not None}


def _train_policy(
    train_one: _Training, resolved: ResolvedConfig, data: TensorDictBase
) -> tuple[nn.Module, dict[str, float]]:
    """A policy of its own, with the updates that a planner would have."""
    options, task = resolved.options, resolved.task
    (phase,) = resolved.method.phases
    policy = resolved.method.build(data["state"].shape[-1], task.action_dim, task.planner_features(), resolved.planner)
    has_action = data["has_action"].squeeze(-1)
    seen = data[torch.isin(data["episode"], data["episode"][has_action])]
    states = cut_windows(extrapolate_ends(seen, HORIZON - 1), WINDOW, select=["state"], pad_before=1)["state"]
    policy.fit_normalizers(states, data["action"][has_action])
    policy.to(options.device)
    # at the end of a demonstration only the steps that were recorded count
    buffer = make_window_buffer(
        data,
        WINDOW,
        options.batch_size,
        select=_KEYS,
        pad_before=1,
        pad_after=HORIZON - 1,
        labelled_share=LABELLED_SHARES[phase.windows],
    )
    loss = phase.loss(policy, dtype=training_dtype(options.precision, options.device))
    augment = augmentation(task, actions=True)
    num_steps = max(round(options.steps * phase.share), 1)
    values = train_one(
        phase.name,
        loss,
        lambda: augment(buffer.sample()),
        num_steps=num_steps,
        learning_rate=options.planner_learning_rate,
        weight_decay=WEIGHT_DECAY,
        target_update=moving_average(loss, num_steps),
    )
    loss.target_network_params.to_module(policy)
    return policy, values


def _relabelled(train_one: _Training, resolved: ResolvedConfig, data: TensorDictBase) -> TensorDictBase:
    """The data with the teacher's actions where there is no label."""
    teacher = resolved.teacher
    phases = tuple(replace(phase, name=f"teacher_{phase.name}") for phase in teacher.phases)
    entry = {"method": teacher.name, "preset": resolved.controller["preset"]}
    view = resolved.controller_view(data)
    controller, _, _ = _train_network(train_one, replace(teacher, phases=phases), entry, view)
    labelled = relabel(controller, view, window=max(WINDOW, controller.num_window_frames))
    if resolved.task.targets:
        labelled["action"] = labelled["action"] + data["state"][..., list(resolved.task.targets)]
    return data.copy().update(labelled.select("action", "has_action"))
