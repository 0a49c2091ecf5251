# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap train``: demonstrations and a label budget in, a run directory with planner and controller out."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import time
from typing import Any

import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from torchrl_koap.data import WindowTable, subsample_trajectories
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import WINDOW, Task, get_task
from torchrl_koap.training.action_errors import AFTER, BEFORE, UNITS, write_analysis
from torchrl_koap.training.builders import (
    build_controller,
    build_diffusion_policy,
    build_planner,
    load_demonstrations,
    set_up_torch,
)
from torchrl_koap.training.checkpoints import load_weights
from torchrl_koap.training.config import Train, budget_of, configure, method_of, started_with, with_task_defaults
from torchrl_koap.training.controller import train_controller
from torchrl_koap.training.planner import train_planner
from torchrl_koap.training.run_directory import RunDirectory


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
    method = method_of(options)
    lookup(("csv", "wandb"), options.logger, "logger")
    if options.logger == "wandb" and importlib.util.find_spec("wandb") is None:
        raise ValueError("--logger wandb needs an extra: pip install 'torchrl_koap[wandb]'")
    if method.acts and options.planner_from is not None:
        raise ValueError(f"method {options.method!r} is a policy of its own and has no planner to take over")
    if options.steps < 1 or options.controller_steps < 0:
        raise ValueError(f"steps must be >= 1, got {options.steps} and {options.controller_steps}")
    for name in ("batch_size", "controller_batch_size", "checkpoint_every"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(options, name)}")
    budget = budget_of(options)
    set_up_torch(options.threads, options.device)
    config = configure(run, options)
    # finds unknown names before any work is done
    if method.acts:
        build_diffusion_policy(config["planner"], task.state_dim, task.action_dim, task.planner_features())
    else:
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
    labelled, report = budget.apply(data, command=task.command_columns)
    # not drawn by the seed: all runs know the same unlabelled trajectories, but for as many as have labels
    labelled = subsample_trajectories(labelled, options.observation_fraction).to(options.device)
    _check_lengths(options, config, task, labelled)
    run.write_json("config.json", config)  # not before the data are known to be good: a wrong call leaves nothing

    began = time.perf_counter()
    logger = _make_logger(options)
    try:
        torch.manual_seed(options.seed)
        trained, planner_values = None, {}
        if not method.acts:
            trained, planner_values = train_planner(run, options, config, task, labelled, logger)
        planned = time.perf_counter()
        torch.manual_seed(options.seed)  # the controller does not depend on where the planner is from
        controller, fit, controller_values = train_controller(run, options, config, task, labelled, logger)
    finally:
        if logger is not None:
            logger.close()
    summary = {
        "labels": report.as_dict(),
        "trajectories_used": len(labelled["episode"].unique()),
        "planner_parameters": 0 if trained is None else sum(p.numel() for p in trained.parameters()),
        "controller_parameters": sum(p.numel() for p in controller.parameters()),
        "train_seconds": {"planner": planned - began, "controller": time.perf_counter() - planned},
        "planner": planner_values,
        "controller": controller_values,
        "controller_updates": controller_values.pop("updates", 0),
        "decoder_fit": fit,
    }
    if options.analysis and not method.acts:
        columns = task.controller_columns(options.controller_state)
        analysis = write_analysis(run, task, data, labelled, controller, columns)
        summary[f"action_error_{UNITS.get(task.action_unit, task.action_unit)}"] = analysis
    run.write_json("summary.json", summary)
    return summary


def _check_lengths(options: Train, config: dict[str, Any], task: Task, data: TensorDictBase) -> None:
    """Finds trajectories that are too short now rather than after the planner was trained."""
    if method_of(options).acts:
        WindowTable.build(data, WINDOW, pad_before=1)
        return
    width = len(task.controller_columns(options.controller_state))
    controller = build_controller(config["controller"], width, task.action_dim)
    WindowTable.build(data, max(WINDOW, controller.num_window_frames), pad_before=controller.num_past)
    if options.analysis:
        WindowTable.build(data, BEFORE + 1 + AFTER, pad_before=BEFORE)


def _make_logger(options: Train):
    if options.logger == "csv":
        return None
    from torchrl.record.loggers import get_logger

    mode = os.environ.get("WANDB_MODE", "offline")
    return get_logger("wandb", str(options.out), options.out.name, wandb_kwargs={"mode": mode, "project": "koap"})
