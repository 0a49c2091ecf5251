# This source code is licensed under the MIT license found in the LICENSE file.
"""The whole training: demonstrations and a label budget in, a run directory with planner and controller out."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import WindowTable, subsample_trajectories
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.progress import count_up_to, open_logger, progress_bar
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_weights
from torchrl_koap.tasks import WINDOW
from torchrl_koap.training.action_errors import AFTER, BEFORE, error_entry, write_analysis
from torchrl_koap.training.builders import build_controller
from torchrl_koap.training.command_model import with_label_commands
from torchrl_koap.training.controller import train_controller
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.diffusion_builders import build_planner
from torchrl_koap.training.digests import forget_digests, write_digests
from torchrl_koap.training.planner import train_planner
from torchrl_koap.training.provenance import fingerprint, to_json
from torchrl_koap.training.resolved import ResolvedConfig, resolve
from torchrl_koap.training.resume import begun_by, check_data, check_resume, started_with
from torchrl_koap.training.validation import choose_validation, validation_of, without_validation


def train(config: TrainConfig, *, command: str | None = None) -> dict[str, Any]:
    """Trains planner and controller, or a policy of its own; ``koap train`` calls this.

    Args:
        config (TrainConfig): what to train on what, and where to write it.

    Keyword Args:
        command (str, optional): how it was called, if from a shell; kept in ``config.json``.

    Returns:
        dict: the summary that is also written to ``summary.json``: labels spent, sizes, losses, action errors.

    Raises:
        ValueError: for unknown options and budgets that select nothing.
        RunDirectoryError: if the folder holds another run, one that was not asked to be resumed, or one that is being
            worked on.
        PluginError: if a plugin cannot be imported.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap import TrainConfig, train
        >>> from torchrl_koap.data import save_demonstrations
        >>> states = [np.random.default_rng(i).normal(size=(30, 4)).cumsum(0) for i in range(6)]
        >>> actions = [np.diff(frames[:, :2], axis=0) if i < 2 else None for i, frames in enumerate(states)]
        >>> with tempfile.TemporaryDirectory() as root:
        ...     arm = save_demonstrations(root + "/arm", states, actions, control_hz=30, robot=[0, 1])
        ...     config = TrainConfig(dataset=str(arm), out=Path(root) / "run", steps=2, controller_steps=2, threads=1)
        ...     summary = train(config)
        >>> summary["labels"]["labelled_transitions"], summary["labels"]["total_transitions"]
        (58, 174)
    """
    run = RunDirectory(config.out)
    with ExitStack() as held:
        mine = (run.path / ".lock").exists()  # a new folder is not made before the options are known to do
        if mine:
            held.enter_context(run.locked("koap train"))
        config = started_with(run, config)
        load_plugins(config.plugins)
        resolved = resolve(config)
        options, task = resolved.options, resolved.task
        set_up_torch(options.threads, options.device)
        content = to_json(resolved, begun_by(run, command))
        check_resume(run, content, resume=options.resume)
        check_networks(resolved)

        # files are read in a moment, unless there are thousands of them
        wait = 0 if options.dataset == "scripted" else 3
        with progress_bar(None, "demonstrations", unit="episode", delay=wait) as bar:
            data = load_demonstrations(options.dataset, task, episodes=options.episodes, progress=count_up_to(bar))
        resolved = resolved.with_labels_of(data)
        options = resolved.options
        content["label_fraction"] = options.label_fraction
        labelled, report = resolved.budget.apply(data, command=task.command_columns)
        if resolved.method.knows_commands:
            labelled = with_label_commands(labelled, data, task.command_columns)
        # not drawn by the seed: all runs know the same unlabelled trajectories, but for as many as have labels
        labelled = subsample_trajectories(labelled, options.observation_fraction).to(options.device)
        content["data"] = fingerprint(labelled)
        check_data(run, content, force=options.force_data)
        held_out = _validation(resolved, labelled)
        if held_out:
            content["validation_episodes"] = held_out
        _check_lengths(resolved, labelled)
        planner_data = without_validation(labelled, held_out)
        labelled = without_validation(labelled, held_out, keep_labelled=True)
        if not mine:
            held.enter_context(run.locked("koap train"))
            check_resume(run, content, resume=options.resume)  # another one may have begun here in the meantime
        if options.force_data:
            forget_digests(run)
        run.write_json("config.json", content)  # not before the data are known to be good: a wrong call leaves nothing

        began = time.perf_counter()
        with open_logger(options.logger, options.out) as logger:
            torch.manual_seed(options.seed)
            planner, planner_values = None, dict[str, Any]()
            if resolved.method.has_planner:
                planner, planner_values = train_planner(run, resolved, planner_data, logger)
            planned = time.perf_counter()
            torch.manual_seed(options.seed)  # the controller does not depend on where the planner is from
            controller, fit, controller_values = train_controller(run, resolved, labelled, logger)
        summary = {
            "labels": report.as_dict(),
            "trajectories_used": len(labelled["episode"].unique()),
            "planner_parameters": 0 if planner is None else sum(p.numel() for p in planner.parameters()),
            "controller_parameters": sum(p.numel() for p in controller.parameters()),
            "train_seconds": {"planner": planned - began, "controller": time.perf_counter() - planned},
            "planner": planner_values,
            "controller": controller_values,
            "controller_updates": controller_values.pop("updates", 0),
            "decoder_fit": fit,
        }
        if options.analysis and resolved.method.has_planner:
            analysis = write_analysis(run, task, data, labelled, controller, resolved.columns)
            summary[error_entry(task.action_unit)] = analysis
        run.write_json("summary.json", summary)
        write_digests(run)
    return summary


def train_shared_planner(config: TrainConfig) -> dict[str, float]:
    """Trains a planner alone, for other runs to take over (``planner_from``); all actions are hidden before.

    Args:
        config (TrainConfig): as for :func:`train`; what concerns labels and controllers is not used.

    Returns:
        dict: its last losses.
    """
    run = RunDirectory(config.out)
    load_plugins(config.plugins)
    resolved = resolve(config)
    options = resolved.options
    set_up_torch(options.threads, options.device)
    data = load_demonstrations(options.dataset, resolved.task)
    # all cells of a curve share it, whichever labels they draw: only labels that there are count as such here
    held_out = choose_validation(data, options.validation_fraction, seed=options.seed)
    data["action"] = torch.full_like(data["action"], torch.nan)
    data["has_action"] = torch.zeros_like(data["has_action"])
    data = subsample_trajectories(data, options.observation_fraction).to(options.device)
    content = to_json(resolved) | {"data": fingerprint(data)}
    if held_out:
        content["validation_episodes"] = held_out
    with run.locked("koap train"):
        check_resume(run, content, resume=options.resume)
        check_data(run, content, force=options.force_data)
        if options.force_data:
            forget_digests(run)
        run.write_json("config.json", content)
        torch.manual_seed(options.seed)
        values = train_planner(run, resolved, without_validation(data, held_out))[1]
        write_digests(run)
    return values


def _validation(resolved: ResolvedConfig, labelled: TensorDictBase) -> list[int]:
    """Trajectories that the planner does not see, or, where it is taken over, has not seen."""
    options = resolved.options
    if not resolved.method.has_planner:
        return []
    if options.planner_from is not None:
        return validation_of(options.planner_from, options.dataset)
    return choose_validation(labelled, options.validation_fraction, seed=options.seed)


def check_networks(resolved: ResolvedConfig) -> None:
    """Finds unknown names, networks that cannot read the task's state and weights that do not fit, before any work.

    Args:
        resolved (ResolvedConfig): all options.

    Raises:
        ValueError: naming what does not fit.
        CheckpointError: if the planner to take over is of another task or size.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training import TrainConfig, resolve
        >>> from torchrl_koap.training.run import check_networks
        >>> check_networks(resolve(TrainConfig(out=Path("run"), task="sorting")))
    """
    task, features = resolved.task, resolved.task.planner_features()
    if not resolved.method.has_planner:
        resolved.method.build(task.state_dim, task.action_dim, features, resolved.planner)
        return
    planner = build_planner(resolved.planner, task.state_dim, features)
    if resolved.options.planner_from is not None:
        load_weights(Path(resolved.options.planner_from) / "planner.safetensors", planner, task=task.name)
    build_controller(resolved.controller, len(resolved.columns), task.action_dim, method=resolved.method)


def _check_lengths(resolved: ResolvedConfig, data: TensorDictBase) -> None:
    """Finds trajectories that are too short now rather than after the planner was trained."""
    if not resolved.method.has_planner or resolved.method.fit is not None:
        WindowTable.build(data, WINDOW, pad_before=1)
        return
    controller = build_controller(
        resolved.controller, len(resolved.columns), resolved.task.action_dim, method=resolved.method
    )
    WindowTable.build(data, max(WINDOW, controller.num_window_frames), pad_before=controller.num_past)
    if resolved.options.analysis:
        WindowTable.build(data, BEFORE + 1 + AFTER, pad_before=BEFORE)
