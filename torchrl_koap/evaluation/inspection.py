# This source code is licensed under the MIT license found in the LICENSE file.
"""Which part of a trained run fails (planner, controller, data), what its latent actions hold, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data import controller_view, trajectory_lengths
from torchrl_koap.evaluation.config import EvalConfig
from torchrl_koap.evaluation.diagnosis import (
    coverage,
    executed_success,
    follow_recordings,
    imagine,
    imagined_success,
    left_recordings,
    tracking_errors,
)
from torchrl_koap.evaluation.latent_space import analyse_latent
from torchrl_koap.evaluation.latent_verdict import MODELS, OUTSIDE_THE_BUDGET, error_unit, judge_latent_model
from torchrl_koap.evaluation.places import choose_contexts
from torchrl_koap.evaluation.rollouts import make_gain, make_leash, make_policy, roll_out
from torchrl_koap.evaluation.statistics import rate
from torchrl_koap.evaluation.trained_run import TrainedRun, execution_of, load_run
from torchrl_koap.evaluation.training_data import load_training_data
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.runs.plugins import Plugins, load_plugins
from torchrl_koap.runs.pretrained import writable_folder
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import Task

_NEAR = 0.015  # m; recorded tool paths followed within this are followed well


@dataclass
class InspectConfig:
    """Which part of a trained run fails, and what its latent actions hold.

    Attributes:
        episodes: episodes of each of the three experiments.
        dataset: demonstrations to compare with (default: those the run was trained on).
        out: folder to write to instead of the run's own; what the run is made of is copied there.
        seed: seed of the planner's noise.
        replan_interval: control steps per plan (default: as `koap eval` has it, and likewise the next).
        blend_decay: share of the distance between state and plan that is left after each step.
        latent_only: look into the latent space alone: seconds, without the experiments in the simulator.
        latent_steps: control steps that the latent dynamics predict (fewer where demonstrations are short).
        threads: torch and simulator threads.
        device: "cpu" or "cuda".
        plugins: modules that register tasks or methods, besides those that the run was trained with.

    Examples:
        >>> from torchrl_koap.evaluation.inspection import InspectConfig, inspect
        >>> inspect("runs/koap", InspectConfig(latent_only=True)).result["verdict"]  # doctest: +SKIP
    """

    episodes: int = 30
    dataset: str | None = None
    out: Path | None = None
    seed: int = 500
    replan_interval: int | None = None
    blend_decay: float | None = None
    latent_only: bool = False
    latent_steps: int = 10
    threads: int = 2
    device: str = "cpu"
    plugins: Plugins = ()


@dataclass(frozen=True)
class Inspection:
    """What :func:`inspect` found.

    Args:
        result (dict): what ``inspect.json`` holds: the three experiments, if they were made, ``latent``, ``verdict``.
        task (Task): the task.
        eigenvalues (Tensor, optional): of the Koopman operator, complex ``[m]``; None for a method without one.
        folder (Path): where the run is, or what it is made of was copied to.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.evaluation.inspection import Inspection
        >>> from torchrl_koap.tasks import get_task
        >>> found = Inspection({"verdict": "the planner fails"}, get_task("avoiding"), None, Path("runs/koap"))
        >>> found.result["verdict"]
        'the planner fails'
    """

    result: dict[str, Any]
    task: Task
    eigenvalues: Tensor | None
    folder: Path


def inspect(run: str | Path, config: InspectConfig | None = None) -> Inspection:
    """Makes the three experiments and looks into the latent space.

    ``imagined`` is the planner alone, which a task without a goal in its states cannot judge; ``followed`` the
    controller alone on recorded states (blind to where objects went), ``closed_loop`` both. Plans are followed as
    ``koap eval`` follows them. ``latent`` (:func:`~torchrl_koap.evaluation.latent_space.analyse_latent`) reads labels
    outside the budget, for analysis only.

    Args:
        run (str or Path): a run directory, or ``"pretrained:NAME"``.
        config (InspectConfig, optional): how many episodes, and how.

    Returns:
        Inspection: errors and successes of the parts, and which one fails.

    Raises:
        ValueError: for fewer than one episode or step, or a run without a planner.
        RunDirectoryError: if the folder is no finished run.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap import TrainConfig, train
        >>> from torchrl_koap.data import save_demonstrations
        >>> from torchrl_koap.evaluation import InspectConfig, inspect
        >>> states = [np.random.default_rng(i).normal(size=(30, 4)).cumsum(0) for i in range(6)]
        >>> actions = [np.diff(frames[:, :2], axis=0) if i < 2 else None for i, frames in enumerate(states)]
        >>> with tempfile.TemporaryDirectory() as root:
        ...     arm = save_demonstrations(root + "/arm", states, actions, control_hz=30, robot=[0, 1])
        ...     _ = train(TrainConfig(dataset=str(arm), out=Path(root) / "run", steps=2, controller_steps=2, threads=1))
        ...     found = inspect(root + "/run", InspectConfig(latent_only=True, threads=1))
        >>> sorted(found.result)
        ['latent', 'verdict']
    """
    config = InspectConfig() if config is None else config
    for name in ("episodes", "latent_steps"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(config, name)}")
    if config.seed < 0:
        raise ValueError(f"seed must be >= 0, got {config.seed}")
    set_up_torch(config.threads, config.device)
    load_plugins(config.plugins)
    trained = load_run(run)
    task = trained.task
    if task.env is None and not config.latent_only:
        raise ValueError(
            f"task {task.name!r} has no environment to make experiments in: --latent-only looks into the latent space,"
            " `koap eval` judges plans and actions on recorded data"
        )
    folder = writable_folder(run) if config.out is None else None  # refused before anything is read
    dataset = config.dataset or trained.directory.read_entry("config.json", "dataset")
    data = load_training_data(trained, dataset)
    directory = RunDirectory(folder or writable_folder(run, config.out))
    if config.latent_only:  # what earlier experiments found stays
        earlier = directory.read_json("inspect.json") if (directory.path / "inspect.json").exists() else {}
        result = {name: value for name, value in earlier.items() if name != "verdict"}
    elif trained.planner is None:
        method = directory.read_entry("config.json", "method")
        raise ValueError(f"method {method!r} is a policy of its own: there are no planner and controller to tell apart")
    else:
        result = _experiments(config, trained, data)
    result["latent"] = _look_into(config, trained, data)
    result["verdict"] = verdict(result, task)
    values = getattr(getattr(trained.controller, "operator", None), "eigenvalues", None)
    return Inspection(result, task, None if values is None else values(), directory.path)


def _experiments(config: InspectConfig, trained: TrainedRun, data: TensorDictBase) -> dict[str, Any]:
    task = trained.task
    planner, controller = trained.planner.to(config.device), trained.controller.to(config.device)
    asked = EvalConfig(replan_interval=config.replan_interval, blend_decay=config.blend_decay)
    settings = execution_of(trained, asked)
    interval = settings["replan_interval"]
    settings |= {"controller_columns": trained.columns, "action_rule": task.action_rule}
    settings["leash"] = make_leash(task, settings.pop("command_lead"))
    settings["action_gain"] = make_gain(task, settings["action_gain"])
    seeds = list(range(config.seed, config.seed + config.episodes))
    from torchrl_koap.envs.registry import make_env_of  # takes seconds

    make_env = make_env_of(task, num_threads=config.threads)
    _, contexts = choose_contexts(task, config.episodes)
    with progress_bar(3, "experiments", unit="experiment") as bar:
        several = trained.candidates
        policy = make_policy(planner, controller, state_columns=task.state_of, candidates=several, **settings)
        closed = roll_out(policy, make_env, seeds, max_steps=task.max_steps, contexts=contexts)
        bar.update()
        followed = follow_recordings(planner, controller, task, data, make_env, episodes=config.episodes, **settings)
        bar.update()
        judged = {}
        if task.goal is not None:
            start = torch.stack([task.state_of(episode["observation"][0]) for episode in closed]).to(config.device)
            steps = max(int(trajectory_lengths(data).max() * 1.5), 50)
            imagined = imagine(planner, start, interval=interval, max_steps=steps, seed=config.seed).cpu()
            judged["imagined"] = rate(imagined_success(task, imagined))
        bar.update()
    tracked = tracking_errors(task, followed, interval)
    if task.objects and task.position in tracked:
        left = left_recordings(task, followed, interval, beyond=_NEAR)
        judged["recordings_left"] = {"count": left, "episodes": len(followed)}
    return judged | {
        "followed": rate(executed_success(followed)),
        "closed_loop": rate(executed_success(closed)),
        "plan_to_execution": tracking_errors(task, closed, interval),
        "recording_to_execution": tracked,
        "distance_to_demonstrations": coverage(task, closed, data),
    }


def _look_into(config: InspectConfig, trained: TrainedRun, data: TensorDictBase) -> dict[str, Any]:
    """What :func:`analyse_latent` finds, or a note for methods without latent actions."""
    controller, task = trained.controller.cpu(), trained.task
    if not isinstance(controller, KoopmanInverseDynamics):
        method = trained.directory.read_entry("config.json", "method")
        return {"note": f"method {method!r} has no latent actions to look into"}
    labelled = torch.zeros(len(data), dtype=torch.bool)
    if config.dataset is None:
        labelled = trained.budget.apply(data)[0]["has_action"].squeeze(-1)
    columns = trained.columns
    parts = {
        name: [place for place, column in enumerate(columns) if part.start <= column < part.stop]
        for name, part in task.state_slices.items()
    }
    parts = {name: places for name, places in parts.items() if places}
    view = controller_view(data, columns, action_targets=task.targets)
    return analyse_latent(controller, view, labelled, parts, horizon=config.latent_steps)


def verdict(result: dict[str, Any], task: Task) -> str:
    """What the figures say: a sentence on the experiments, if there are any, and one on the latent space.

    Args:
        result (dict): of :func:`inspect`.
        task (Task): the task.
    """
    sentences = [_experiments_say(result)] if "closed_loop" in result else []
    latent = result.get("latent", {})
    if "multi_step" in latent:
        sentences.append(_latent_says(latent, task))
    elif not sentences:
        sentences.append(latent["note"])
    return ". ".join(sentences)


def _latent_says(latent: dict[str, Any], task: Task) -> str:
    errors = latent["multi_step"]
    part = next(iter(errors["koopman"]))
    shown, factor = error_unit(part, task)
    ahead = {model: f"{factor * errors[model][part][-1]:.3g} {shown}".rstrip() for model in MODELS}
    outside = latent[OUTSIDE_THE_BUDGET]
    faults = judge_latent_model(errors)
    said = f"A fault to look into: {'; '.join(faults)}. " if faults else ""
    return said + (
        f"{errors['steps']} steps ahead the latent dynamics miss the {part.replace('_', ' ')} by {ahead['koopman']}"
        f" ({ahead['reconstruction']} of mapping back alone), a linear model on raw states by {ahead['linear']},"
        f" standing still by {ahead['copy_last']}. {_probe_says(outside)}"
    )


def _probe_says(outside: dict[str, Any]) -> str:
    if "note" in outside:
        return outside["note"].capitalize()
    shared, judged = (outside.get(name, 0) for name in ("judged_trajectories_in_budget", "judged_trajectories"))
    probe, own = (min(outside[name]) for name in ("probe_r2", "decoder_r2"))
    head, reservation = "Outside the budget, for analysis only", ""
    if shared and shared == judged:
        head = "On labels of the budget, which the run's decoder was fitted on"
    elif shared:
        reservation = f" ({shared} of these {judged} have labels in the budget)"
    return (
        f"{head}: a linear probe on all labels explains {probe:.1%} of the hardest action dimension on"
        f" held-out trajectories, the run's own decoder {own:.1%}{reservation}"
    )


def _experiments_say(result: dict[str, Any]) -> str:
    """What the three experiments say, in a sentence.

    Where things are pushed or grasped, recorded tool paths do not answer to where the objects went: there the
    controller is judged by how near the tool stays to them. A planner whose task has no goal is not judged.
    """
    followed, closed = (result[name]["rate"] for name in ("followed", "closed_loop"))
    imagined = result["imagined"]["rate"] if "imagined" in result else None
    if closed >= 0.9:
        return "nothing to find: the closed loop succeeds"
    parts = []
    if imagined is not None and imagined < 0.9:
        parts.append(f"the planner's own imagination reaches the goal in {imagined:.0%} of the episodes only")
    if "recordings_left" in result:
        left, count = (result["recordings_left"][name] for name in ("count", "episodes"))
        if left > 0.1 * count:
            paths = f"{left} of {count} recorded tool paths"
            parts.append(f"the controller leaves {paths} by more than {1e3 * _NEAR:.0f} mm")
    elif followed < 0.9:
        parts.append(f"the controller follows recorded states to the goal in {followed:.0%} only")
    distance = result["distance_to_demonstrations"]
    if distance and distance["visited_95"] > 2 * distance["demonstrated_95"]:
        parts.append("executed states lie far from every demonstration")
    if parts:
        return "; ".join(parts)
    if imagined is None:
        return "the controller works alone: the planner, or plans that start from executed states, are what is left"
    return "planner and controller work alone, not together: plans that start from executed states are worse"
