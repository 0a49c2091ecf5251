# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap train``: demonstrations and a label budget in, a run directory with planner and controller out."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_koap.analysis import AFTER, BEFORE, UNITS, write_analysis
from torchrl_koap.assembly import METHODS, build_controller, build_planner, load_demonstrations, set_up_torch
from torchrl_koap.checkpoints import load_weights, save_tensors, save_weights
from torchrl_koap.closed_form import fit_closed_form
from torchrl_koap.commands.train_options import Train, configure, started_with, with_task_defaults
from torchrl_koap.data import (
    ExchangeAugmentation,
    LabelBudget,
    RecoveryAugmentation,
    SceneAugmentation,
    WindowTable,
    controller_view,
    cut_windows,
    extrapolate_ends,
    make_window_buffer,
)
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS, KoopmanInverseDynamics, StatePlanner
from torchrl_koap.objectives import InverseDynamicsLoss, KOAPLoss, PlannerLoss
from torchrl_koap.run_directory import RunDirectory
from torchrl_koap.tasks import HISTORY, HORIZON, WINDOW, Task, get_task
from torchrl_koap.training import phase_finished, train


def run_train(options: Train) -> dict[str, Any]:
    """Trains; returns the summary that is also written to ``summary.json``.

    Raises:
        ValueError: for unknown options and budgets that select nothing.
        RunDirectoryError: if the folder holds another run, or one that was not asked to be resumed.
    """
    run = RunDirectory(options.out)
    options = started_with(run, options)
    task = get_task(options.task)
    options = with_task_defaults(options, task)
    lookup(METHODS, options.method, "method")
    lookup(PRESETS, options.preset, "preset")
    lookup(("ridge", "sgd"), options.decoder, "decoder")
    lookup(("csv", "wandb"), options.logger, "logger")
    if options.logger == "wandb" and importlib.util.find_spec("wandb") is None:
        raise ValueError("--logger wandb needs an extra: pip install 'torchrl_koap[wandb]'")
    if options.decoder == "sgd" and options.method == "linear":
        raise ValueError("method 'linear' is a closed form: it has no decoder 'sgd'")
    if options.steps < 1 or options.controller_steps < 0:
        raise ValueError(f"steps must be >= 1, got {options.steps} and {options.controller_steps}")
    for name in ("batch_size", "controller_batch_size", "checkpoint_every"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(options, name)}")
    set_up_torch(options.threads, options.device)
    config = configure(run, options)
    # finds unknown names before any work is done
    planner = build_planner(config["planner"], task.state_dim, task.planner_features())
    if options.planner_from is not None:
        load_weights(options.planner_from / "planner.safetensors", planner, task=task.name)

    with tqdm(desc="demonstrations", unit="episode", disable=options.dataset != "scripted") as bar:
        data = load_demonstrations(
            options.dataset,
            task,
            episodes=options.episodes,
            progress=lambda recorded, wanted: bar.update(recorded - bar.n),
        )
    amount = options.label_fraction if options.label_count is None else options.label_count
    budget = LabelBudget(amount, unit=options.label_unit, seed=options.seed, window=WINDOW, history=HISTORY)
    command = task.observation[task.command]
    labelled, report = budget.apply(data, command=command)
    labelled = labelled.to(options.device)
    columns = task.controller_columns(options.controller_state)
    _check_lengths(options, config, task, labelled, len(columns))
    run.write_json("config.json", config)  # not before the data are known to be good: a wrong call leaves nothing

    began = time.perf_counter()
    logger = _make_logger(options)
    try:
        torch.manual_seed(options.seed)
        trained, planner_values = _train_planner(run, options, config, task, labelled, logger)
        planned = time.perf_counter()
        torch.manual_seed(options.seed)  # the controller does not depend on where the planner is from
        view = controller_view(labelled, columns)
        controller, fit, controller_values = _train_controller(run, options, config, task, view, logger)
    finally:
        if logger is not None:
            logger.close()
    summary = {
        "labels": report.as_dict(),
        "planner_parameters": sum(p.numel() for p in trained.parameters()),
        "controller_parameters": sum(p.numel() for p in controller.parameters()),
        "train_seconds": {"planner": planned - began, "controller": time.perf_counter() - planned},
        "planner": planner_values,
        "controller": controller_values,
        "decoder_fit": fit,
    }
    if options.analysis:
        analysis = write_analysis(run, task, data, labelled, controller, columns)
        summary[f"action_error_{UNITS[task.action_unit]}"] = analysis
    run.write_json("summary.json", summary)
    return summary


def _check_lengths(options: Train, config: dict[str, Any], task: Task, data: TensorDictBase, width: int) -> None:
    """Finds trajectories that are too short now rather than after the planner was trained."""
    controller = build_controller(config["controller"], width, task.action_dim)
    WindowTable.build(data, max(WINDOW, controller.num_window_frames), pad_before=controller.history)
    if options.analysis:
        WindowTable.build(data, BEFORE + 1 + AFTER, pad_before=BEFORE)


def _make_logger(options: Train):
    if options.logger == "csv":
        return None
    from torchrl.record.loggers import get_logger

    mode = os.environ.get("WANDB_MODE", "offline")
    return get_logger("wandb", str(options.out), options.out.name, wandb_kwargs={"mode": mode, "project": "koap"})


def _train_planner(
    run: RunDirectory, options: Train, config: dict[str, Any], task: Task, data: TensorDictBase, logger
) -> tuple[StatePlanner, dict[str, float]]:
    planner = build_planner(config["planner"], data["state"].shape[-1], task.planner_features()).to(options.device)
    source = run.path if options.planner_from is None else Path(options.planner_from)
    if options.planner_from is not None or (options.resume and phase_finished(run, "planner")):
        load_weights(source / "planner.safetensors", planner, task=task.name)
        if options.planner_from is not None:
            save_weights(run.path / "planner.safetensors", planner, {"task": task.name, "kind": "planner"})
        return planner, run.last_metrics("planner")
    # a plan made near the end of a demonstration needs a future, one made at its start a repeated first frame
    extended = extrapolate_ends(data, HORIZON - 1)
    planner.fit_normalizers(cut_windows(extended, WINDOW, select=["state"], pad_before=1)["state"])
    planner.to(options.device)
    buffer = make_window_buffer(extended, WINDOW, options.batch_size, select=["state"], pad_before=1)
    augment = _augmentation(options, task)
    loss = PlannerLoss(planner)
    with _bar(options.steps, "planner") as bar:
        values = train(
            "planner",
            loss,
            lambda: augment(buffer.sample()),
            num_steps=options.steps,
            learning_rate=options.planner_learning_rate,
            weight_decay=1e-4,
            target_update=SoftUpdate(loss, eps=min(0.998, 1 - 10 / (options.steps + 10))),
            run=run,
            logger=logger,
            checkpoint_every=options.checkpoint_every,
            resume=options.resume,
            progress=_progress(bar),
        )
    loss.target_planner_params.to_module(planner)
    save_weights(run.path / "planner.safetensors", planner, {"task": task.name, "kind": "planner"})
    return planner, values


def _augmentation(options: Train, task: Task) -> TensorDictSequential:
    """What windows undergo before the planner learns from them."""
    steps = []
    if options.exchange and task.alike_columns():
        steps.append(ExchangeAugmentation(task.alike_columns()))
    if task.scene and (options.scene_shift or options.scene_turn):
        shift, turn = options.scene_shift, options.scene_turn
        steps.append(SceneAugmentation(*task.scene_columns(), shift=shift, turn=turn, history=HISTORY))
    arm = [column for column in task.robot if task.gripper is None or column != task.gripper[1]]
    sigma = options.recovery_sigma
    steps.append(RecoveryAugmentation(sigma, history=HISTORY, columns=arm, tool=task.tool_columns))
    return TensorDictSequential(*steps)


def _train_controller(
    run: RunDirectory, options: Train, config: dict[str, Any], task: Task, data: TensorDictBase, logger
) -> tuple[nn.Module, dict[str, Any], dict[str, float]]:
    controller = build_controller(config["controller"], data["state"].shape[-1], task.action_dim, data)
    controller.to(options.device)
    history = controller.history
    window = max(WINDOW, controller.num_window_frames)
    values: dict[str, float] = {}
    if isinstance(controller, KoopmanInverseDynamics):
        controller.fit_scales(cut_windows(data, window, select=["state"], pad_before=history)["state"])
        joint = options.decoder == "sgd"
        loss: nn.Module | None = KOAPLoss(controller, action_coeff=1.0 if joint else 0.0)
        share = 0.25 if joint else None
    elif options.method == "supervised":
        loss, share = InverseDynamicsLoss(controller), 1.0
    else:
        loss, share = None, None
    num_steps = min(options.controller_steps, options.steps)
    if loss is not None and num_steps:
        keys = ["state", "action", "has_action"]
        buffer = make_window_buffer(
            data, window, options.controller_batch_size, select=keys, pad_before=history, labelled_share=share
        )
        with _bar(num_steps, "controller") as bar:
            values = train(
                "controller",
                loss,
                buffer.sample,
                num_steps=num_steps,
                learning_rate=options.controller_learning_rate,
                weight_decay=1e-3,
                run=run,
                logger=logger,
                checkpoint_every=options.checkpoint_every,
                resume=options.resume,
                progress=_progress(bar),
            )
    closed_form = options.decoder == "ridge" and options.method != "supervised"
    fit = fit_closed_form(controller, data, shared_axes=task.actuated) if closed_form else {}
    save_weights(run.path / "controller.safetensors", controller, {"task": task.name, "kind": "controller"})
    if isinstance(controller, KoopmanInverseDynamics):
        eigenvalues = controller.operator.eigenvalues()
        save_tensors(run.path / "eigenvalues.safetensors", {"real": eigenvalues.real, "imag": eigenvalues.imag})
    return controller, fit, values


def _bar(total: int, description: str) -> tqdm:
    return tqdm(total=total, desc=description, unit="it", smoothing=0.05, mininterval=0.5)


def _progress(bar: tqdm):
    def update(step: int, values: dict[str, float]) -> None:
        bar.update(step - bar.n)
        if values and step % 50 == 0:
            bar.set_postfix(
                {key.removeprefix("loss_"): f"{value:.4f}" for key, value in values.items() if "loss" in key}
            )

    return update
