# This source code is licensed under the MIT license found in the LICENSE file.
"""The whole training, from demonstrations and a label budget to a run directory with planner and controller."""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack
from dataclasses import asdict

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data import open_dataset
from torchrl_koap.data.label_budget import LabelReport, subsample_trajectories
from torchrl_koap.data.quality import plan_coverage
from torchrl_koap.data.sources import find_task_of
from torchrl_koap.data.ted import CAMERAS
from torchrl_koap.data.trajectories import labelled_episodes
from torchrl_koap.modules import StatePlanner
from torchrl_koap.runs.config import TrainConfig, given_options
from torchrl_koap.runs.config_files import to_json, versions
from torchrl_koap.runs.device import set_up_torch, torch_as_before
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.progress import check_logger, count_up_to, open_logger, progress_bar
from torchrl_koap.runs.resume import begun_with, check_data, check_resume
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import CheckpointError, load_weights, save_tensors
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.registry import task_from
from torchrl_koap.training.controller import check_lengths, learn_controller
from torchrl_koap.training.datasets import (
    choose_held_out,
    fingerprint,
    held_out_by,
    held_out_facts,
    split_held_out,
    within_budget,
)
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.loop import Phases
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_planner
from torchrl_koap.training.planner import learn_planner
from torchrl_koap.training.trained import Trained, build_networks, facts_of
from torchrl_koap.vision.encoder import cameras_of


def train(config: TrainConfig, *, command: str | None = None, planner_only: bool = False) -> Trained:
    """Trains planner and controller, or a network that samples actions; ``koap train`` calls this.

    Args:
        config (TrainConfig): the options.

    Keyword Args:
        command (str, optional): the shell command that called it; kept in ``config.json``.
        planner_only (bool): train only a planner, which other runs can use (``planner.source``); all actions are
            hidden.

    Returns:
        Trained: the networks; its ``results`` are also written to ``summary.json``: labels used, sizes, losses.

    Raises:
        ValueError: for unknown options and budgets that select nothing.
        RunDirectoryError: if the folder holds another run, or this one without ``resume``, or if another process works
            in it.
        PluginError: if a plugin cannot be imported.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap import ControllerConfig, PlannerConfig, TrainConfig, train
        >>> from torchrl_koap.data import save_demonstrations
        >>> states = [np.random.default_rng(i).normal(size=(30, 4)).cumsum(0) for i in range(6)]
        >>> actions = [np.diff(frames[:, :2], axis=0) if i < 2 else None for i, frames in enumerate(states)]
        >>> few = {"planner": PlannerConfig(steps=2), "controller": ControllerConfig(steps=2)}
        >>> with tempfile.TemporaryDirectory() as root:
        ...     arm = save_demonstrations(root + "/arm", states, actions, control_hz=30, robot=[0, 1])
        ...     trained = train(TrainConfig(dataset=str(arm), out=Path(root) / "run", **few))
        >>> trained.results["labels"]["labelled_transitions"], trained.results["labels"]["total_transitions"]
        (58, 174)
    """
    run = RunDirectory(given_options(config, TrainConfig).out)
    with ExitStack() as held:
        locked = (run.path / ".lock").exists()  # a new folder is created only after all checks
        if locked:
            held.enter_context(run.locked("koap train"))
        config = begun_with(run, config)
        load_plugins(config.run.plugins)
        task = find_task_of(config.dataset, config.task)
        config = resolve(config, task)
        check_logger(config.run.logger)
        held.enter_context(torch_as_before())
        set_up_torch(config.run.threads, config.run.device)
        check_resume(run, config)
        _check_networks(task, config)
        used, held_out, report = _read_data(task, config, planner_only)
        content = to_json(config) | {"data": fingerprint(used), "versions": versions()}
        if planner_only:
            content["planner_only"] = True
        if (definition := task.definition()) is not None:
            content["task_definition"] = definition
        check_data(run, content)
        content |= held_out_facts(used, held_out)
        if not planner_only:
            check_lengths(task, config, used)
        for_planner, unseen, data = split_held_out(used, held_out)
        if not locked:
            held.enter_context(run.locked("koap train"))
            check_resume(run, config)  # another process may have started a run here since the first check
        if (run.path / "config.json").exists():  # a resumed run keeps its first command, which has all options
            begun = run.read_json("config.json")
            command, content["versions"] = begun.get("command") or command, begun.get("versions") or versions()
        # only after the data were checked, so that a failed call leaves no files
        run.write_json("config.json", content | ({"command": command} if command else {}))
        if all((run.path / name).exists() for name in ("controller.safetensors", "summary.json")):  # it is finished
            return Trained.load(run.path)
        covers, short = plan_coverage(used, task.control_hz)
        if short is not None:
            warnings.warn(short, stacklevel=2)
        cameras = cameras_of(config.dataset)
        for name, projection in cameras.items():
            projection.save(run.path / CAMERAS / f"{name}.safetensors")
        with open_logger(config.run.logger, config.out, to_json(config)) as logger:
            began = time.perf_counter()
            loop, planner, losses = Phases(run, logger, config.run.resume), None, dict[str, float]()
            torch.manual_seed(config.run.seed)
            if get_method(config.method).plans:
                planner, losses = _planner(task, config, for_planner, unseen, loop)
            planned = time.perf_counter()
            if planner_only:
                found = {"planner": losses}
                return Trained(task, config, planner, None, found, tuple(held_out), run.path, cameras)
            torch.manual_seed(config.run.seed)  # the controller is the same whether the planner was trained or loaded
            controller, results = learn_controller(task, config, data, loop)
            facts = facts_of("controller", task, config)
            save_tensors(run.path / "controller.safetensors", controller.state_dict(), facts)
        seconds = {"planner": planned - began, "controller": time.perf_counter() - planned}
        updating = run.seconds()  # of a resumed run, this call has timed only the last part
        seconds["planner"] = max(seconds["planner"], updating.pop("planner", 0.0))
        seconds["controller"] = max(seconds["controller"], sum(updating.values()))
        summary = {
            "labels": asdict(report),
            "plan_covers": covers,
            "trajectories_used": len(data["episode"].unique()),
            "planner_parameters": 0 if planner is None else sum(p.numel() for p in planner.parameters()),
            "controller_parameters": sum(p.numel() for p in controller.parameters()),
            "train_seconds": seconds,
            "planner": losses,
            **results,
        }
        save_tensors(run.path / "demonstrations.safetensors", _report_data(task, used.cpu()))
        run.write_json("summary.json", summary)
    return Trained(task, config, planner, controller, summary, tuple(held_out), run.path, cameras)


def _check_networks(task: Task, config: TrainConfig) -> None:
    """Raises, before any work, if networks cannot read the task's state or weights of ``planner.source`` do not fit."""
    done = config.run.resume and (config.out / "planner.safetensors").exists()
    with torch.random.fork_rng(devices=[]):
        if config.planner.source is not None and not done:
            planner_of_source(task, config)
        build_networks(task, config)


def planner_of_source(task: Task, config: TrainConfig) -> StatePlanner:
    """Loads the planner of ``planner.source``, a run on this task or on one with the same columns and control rate.

    A CheckpointError names what does not fit.
    """
    facts, source = facts_of("planner", task, config), RunDirectory(config.planner.source)
    about = source.read_json("config.json")
    theirs = task_from(about["task"], about.get("task_definition"))
    told = ("state_names", "state_units", "observation_origin", "control_hz")
    others = [name for name in told if getattr(theirs, name) != getattr(task, name)]
    if others and theirs.name == task.name:
        raise CheckpointError(
            f"the planner of {source.path} was trained with another {' and '.join(others)} than the demonstrations have"
            " now: convert them again as then, or train without planner.source"
        )
    if theirs.name != task.name and (others or theirs.env != task.env):
        raise CheckpointError(f"{source.path} was trained on task {theirs.name!r}, not on {task.name!r}")
    planner = build_planner(task, config.planner)
    load_weights(source.path / "planner.safetensors", planner, facts | {"task": theirs.name})
    return planner


def _read_data(
    task: Task, config: TrainConfig, planner_only: bool
) -> tuple[TensorDictBase, list[int], LabelReport | None]:
    """Returns the trajectories that are used, those that the planner does not see, a report of the labels seen."""
    with progress_bar(None, "demonstrations", unit="episode", delay=3) as bar:  # only thousands take this long
        data, _ = open_dataset(config.dataset, task=task, progress=count_up_to(bar))
    planner, share, seed = config.planner, config.labels.trajectories, config.run.seed
    if planner_only:
        # all cells of a curve share this planner, so no label draw counts here, only which actions were recorded
        hidden = data.copy().set("action", torch.full_like(data["action"], torch.nan))
        hidden.set("has_action", torch.zeros_like(data["has_action"]))
        few = len(labelled_episodes(data)) <= share * len(data["episode"].unique())
        kept = subsample_trajectories(data if few else hidden, share)["episode"]
        known = torch.isin(data["episode"], kept)
        held_out = choose_held_out(data[known], planner.held_out, seed=seed)
        return hidden[known].to(config.run.device), held_out, None
    labelled, report = within_budget(task, config, data)
    # independent of the seed: runs differ only in the trajectories with labels, which come first
    used = subsample_trajectories(labelled, share).to(config.run.device)
    if planner.source is not None:
        run = RunDirectory(config.out)
        if (run.path / "config.json").exists():  # resumed: the source may be gone
            return used, run.read_json("config.json").get("held_out_episodes", []), report
        return used, held_out_by(planner.source, labelled), report  # which need not be used here
    return used, choose_held_out(used, planner.held_out, seed=seed), report


def _report_data(task: Task, data: TensorDictBase) -> dict[str, Tensor]:
    """Returns what reports draw of the demonstrations: states, labelled steps, positions of tool and objects."""
    shown = {"state": data["state"], "episode": data["episode"], "labelled": data["has_action"].squeeze(-1)}
    if task.env is None:  # planar positions are known only for tasks with an environment
        return shown
    starts = [task.observation[part].start for part in (task.position, *(body.position for body in task.bodies))]
    tool, *objects = (data["observation"][:, start : start + 2].contiguous() for start in starts)
    return shown | {"position": tool} | ({"objects": torch.stack(objects, 1)} if objects else {})


def _planner(
    task: Task, config: TrainConfig, data: TensorDictBase, held_out: TensorDictBase | None, loop: Phases
) -> tuple[StatePlanner, dict[str, float]]:
    """Returns the planner and its last losses: trained, taken from another run, or loaded if it is finished."""
    path, facts = config.out / "planner.safetensors", facts_of("planner", task, config)
    if path.exists() and config.run.resume:  # weights are written once, at the end of their phase
        planner = build_planner(task, config.planner).to(config.run.device)
        load_weights(path, planner, facts)
        return planner, RunDirectory(config.out).last_metrics("planner")
    if config.planner.source is not None:
        planner, losses = planner_of_source(task, config).to(config.run.device), dict[str, float]()
    else:
        planner, losses = learn_planner(task, config, data, loop, held_out=held_out)
    save_tensors(path, planner.state_dict(), facts)
    return planner, losses
