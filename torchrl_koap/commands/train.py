# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap train``: demonstrations and a label budget in, a run directory with planner and controller out."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import sys
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_koap.analysis import AFTER, BEFORE, write_analysis
from torchrl_koap.assembly import METHODS, build_controller, build_planner, load_demonstrations, set_up_torch
from torchrl_koap.checkpoints import load_weights, save_tensors, save_weights
from torchrl_koap.closed_form import fit_closed_form
from torchrl_koap.data import (
    LabelBudget,
    RecoveryAugmentation,
    WindowTable,
    cut_windows,
    extrapolate_ends,
    make_window_buffer,
)
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS, KoopmanInverseDynamics, StatePlanner
from torchrl_koap.objectives import InverseDynamicsLoss, KOAPLoss, PlannerLoss
from torchrl_koap.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.training import phase_finished, train


@dataclass
class Train:
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        out: run directory to write.
        task: name of the task.
        dataset: "scripted", or a folder of D3IL raw pickles, or one written by `koap demos`.
        label_fraction: share of the trajectories, windows or transitions that keep their actions.
        label_count: number of them instead of a share.
        label_unit: "trajectory", "window" (the paper's levels) or "transition".
        seed: seed of label choice, initialisation and batches.
        method: "koap", "linear" (ridge on raw frames) or "supervised" (inverse dynamics network).
        preset: variant of KOAP: "default", "paper" or "released".
        decoder: "ridge" (closed form on frozen latent actions) or "sgd" (trained with the rest).
        steps: planner updates; a smaller number than the default shortens the controller's training as well.
        controller_steps: controller updates.
        batch_size: windows per planner update.
        controller_batch_size: windows per controller update.
        planner_learning_rate: peak learning rate of the planner.
        controller_learning_rate: peak learning rate of the controller.
        denoiser: "unet", "mlp", "transformer" or "released" (11.9 M parameters).
        channels: widths of the U-Net's levels.
        schedule: "squared_cosine", "linear" or "flow".
        prediction: "sample", "epsilon" or "velocity".
        relative: plan displacements from the current state instead of states.
        recovery_sigma: typical shift (m) of the recovery augmentation; 0 turns it off.
        solver: solver used at evaluation unless told otherwise.
        solver_steps: its number of steps.
        planner_from: run directory whose planner is taken over instead of training one.
        episodes: number of scripted demonstrations.
        threads: torch threads.
        device: "cpu" or "cuda".
        checkpoint_every: updates between two checkpoints, from which --resume goes on.
        resume: go on with an interrupted run; options left at their defaults are those it was started with.
        logger: "csv" (metrics.csv alone) or "wandb" as well (offline unless WANDB_MODE says otherwise).
        analysis: measure the action error on unlabelled demonstrations (reads labels outside the budget, afterwards).
    """

    out: Path
    task: str = "avoiding"
    dataset: str = "scripted"
    label_fraction: float = 0.02
    label_count: int | None = None
    label_unit: str = "trajectory"
    seed: int = 0
    method: str = "koap"
    preset: str = "default"
    decoder: str = "ridge"
    steps: int = 4000
    controller_steps: int = 500
    batch_size: int = 128
    controller_batch_size: int = 256
    planner_learning_rate: float = 3e-3
    controller_learning_rate: float = 1e-3
    denoiser: str = "unet"
    channels: tuple[int, ...] = (32, 64)
    schedule: str = "squared_cosine"
    prediction: str = "sample"
    relative: bool = False
    recovery_sigma: float = 0.004
    solver: str = "dpm++2m"
    solver_steps: int = 10
    planner_from: Path | None = None
    episodes: int = 96
    threads: int = 2
    device: str = "cpu"
    checkpoint_every: int = 500
    resume: bool = False
    logger: str = "csv"
    analysis: bool = True


HISTORY, HORIZON = 2, 14
WINDOW = HISTORY + HORIZON
# options with which a run may be resumed differently; with other threads sums are rounded differently
FREE = ("out", "threads", "checkpoint_every", "resume")


def run_train(options: Train) -> dict[str, Any]:
    """Trains; returns the summary that is also written to ``summary.json``.

    Raises:
        ValueError: for unknown options and budgets that select nothing.
        RunDirectoryError: if the folder holds another run, or one that was not asked to be resumed.
    """
    run = RunDirectory(options.out)
    options = _started_with(run, options)
    task = get_task(options.task)
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
    config = _configure(run, options)
    planner = build_planner(config["planner"], len(task.state_columns))  # finds unknown names before any work is done
    if options.planner_from is not None:
        load_planner(options.planner_from / "planner.safetensors", planner, task)

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
    _check_lengths(options, config, task, labelled)
    run.write_json("config.json", config)  # not before the data are known to be good: a wrong call leaves nothing

    began = time.perf_counter()
    logger = _make_logger(options)
    try:
        torch.manual_seed(options.seed)
        trained, planner_values = _train_planner(run, options, config, task, labelled, logger)
        planned = time.perf_counter()
        torch.manual_seed(options.seed)  # the controller does not depend on where the planner is from
        controller, fit, controller_values = _train_controller(run, options, config, task, labelled, logger)
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
        summary["action_error_mm"] = write_analysis(run, task, data, labelled, controller)
    run.write_json("summary.json", summary)
    return summary


def _started_with(run: RunDirectory, options: Train) -> Train:
    """The options of a resumed run: what was not asked for otherwise is as it was."""
    if not (options.resume and (run.path / "config.json").exists()):
        return options
    earlier = run.read_json("config.json")
    left = [field.name for field in fields(options) if getattr(options, field.name) == field.default]
    kept = {name: earlier[name] for name in left if name in earlier}
    if "channels" in kept:
        kept["channels"] = tuple(kept["channels"])
    if kept.get("planner_from") is not None:
        kept["planner_from"] = Path(kept["planner_from"])
    return replace(options, **kept)


def _check_lengths(options: Train, config: dict[str, Any], task: Task, data: TensorDictBase) -> None:
    """Finds trajectories that are too short now rather than after the planner was trained."""
    controller = build_controller(config["controller"], data["state"].shape[-1], task.action_dim)
    WindowTable.build(data, max(WINDOW, controller.num_window_frames), pad_before=controller.history)
    if options.analysis:
        WindowTable.build(data, BEFORE + 1 + AFTER, pad_before=BEFORE)


def _configure(run: RunDirectory, options: Train) -> dict[str, Any]:
    """Everything that ``config.json`` holds; compared with what is there already."""
    config = asdict(options)
    config |= {name: str(config[name]) for name in ("out", "planner_from") if config[name] is not None}
    config["planner"] = {
        "denoiser": options.denoiser,
        "channels": list(options.channels),
        "schedule": options.schedule,
        "prediction": options.prediction,
        "history": HISTORY,
        "horizon": HORIZON,
        "relative": options.relative,
        "solver": options.solver,
        "solver_steps": options.solver_steps,
        "clip": 1.2 if options.prediction == "sample" else 1.0,
    }
    if options.planner_from is not None:
        config["planner"] = RunDirectory(options.planner_from).read_entry("config.json", "planner")
    config["controller"] = {"method": options.method, "preset": options.preset}
    config["channels"] = list(options.channels)
    config["command"] = "koap " + " ".join(sys.argv[1:])
    config["versions"] = {"python": platform.python_version()} | {
        name: importlib.metadata.version(name) for name in ("torchrl_koap", "torch", "torchrl", "tensordict", "mujoco")
    }
    if (run.path / "config.json").exists():
        if not options.resume:
            raise RunDirectoryError(f"{run.path} holds a run already; choose another --out, or --resume it")
        earlier = run.read_json("config.json")
        free = {*FREE, "command", "versions"}
        changed = [key for key in config if key not in free and config[key] != earlier.get(key)]
        if changed:
            raise RunDirectoryError(
                f"{run.path} was started with another {', '.join(changed)}; it cannot be resumed so"
            )
    return config


def _make_logger(options: Train):
    if options.logger == "csv":
        return None
    from torchrl.record.loggers import get_logger

    mode = os.environ.get("WANDB_MODE", "offline")
    return get_logger("wandb", str(options.out), options.out.name, wandb_kwargs={"mode": mode, "project": "koap"})


def _train_planner(
    run: RunDirectory, options: Train, config: dict[str, Any], task: Task, data: TensorDictBase, logger
) -> tuple[StatePlanner, dict[str, float]]:
    planner = build_planner(config["planner"], data["state"].shape[-1]).to(options.device)
    source = run.path if options.planner_from is None else Path(options.planner_from)
    if options.planner_from is not None or (options.resume and phase_finished(run, "planner")):
        load_planner(source / "planner.safetensors", planner, task)
        if options.planner_from is not None:
            save_weights(run.path / "planner.safetensors", planner, {"task": task.name, "kind": "planner"})
        return planner, run.last_metrics("planner")
    # a plan made near the end of a demonstration needs a future, one made at its start a repeated first frame
    extended = extrapolate_ends(data, HORIZON - 1)
    planner.fit_normalizers(cut_windows(extended, WINDOW, select=["state"], pad_before=1)["state"])
    planner.to(options.device)
    buffer = make_window_buffer(extended, WINDOW, options.batch_size, select=["state"], pad_before=1)
    augment = RecoveryAugmentation(options.recovery_sigma, history=HISTORY)
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


def load_planner(path: Path, planner: StatePlanner, task: Task) -> None:
    """Loads planner weights; the fitted normalisers are part of them."""
    load_weights(path, planner, task=task.name)


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
