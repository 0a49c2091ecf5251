# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap inspect``: which part of a trained run fails (planner, controller, data), what its latent actions hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from torchrl_koap.commands.suggest import budget_of
from torchrl_koap.data import controller_view, trajectory_lengths
from torchrl_koap.evaluation.diagnosis import (
    coverage,
    executed_success,
    follow_recordings,
    imagine,
    imagined_success,
    rate,
    tracking_errors,
)
from torchrl_koap.evaluation.latent_space import MODELS, OUTSIDE_THE_BUDGET, analyse_latent
from torchrl_koap.evaluation.rollouts import make_policy, roll_out
from torchrl_koap.evaluation.run import choose_contexts, columns_of, load_run
from torchrl_koap.modules import KoopmanInverseDynamics, StatePlanner
from torchrl_koap.reports.diagnosis_plot import plot_inspection
from torchrl_koap.reports.latent_plot import error_unit, plot_latent
from torchrl_koap.reports.pictures import FOLDER
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.tasks import REPLAN_INTERVAL, Task
from torchrl_koap.training.builders import load_demonstrations, set_up_torch
from torchrl_koap.training.run_directory import RunDirectory

_NEAR = 0.015  # m; recorded tool paths followed within this are followed well


@dataclass
class Inspect:
    """Find out which part of a trained run fails, and what its latent actions hold.

    Attributes:
        run: run directory of `koap train`.
        episodes: episodes of each of the three experiments.
        dataset: demonstrations to compare with (default: those the run was trained on).
        seed: seed of the planner's noise.
        replan_interval: control steps per plan.
        joining: how slowly plans are joined to the present state.
        latent_only: look into the latent space alone: seconds, without the experiments in the simulator.
        latent_steps: control steps that the latent dynamics predict (fewer where demonstrations are short).
        threads: torch and simulator threads.
        device: "cpu" or "cuda".
    """

    run: tyro.conf.Positional[Path]
    episodes: int = 30
    dataset: str | None = None
    seed: int = 500
    replan_interval: int = REPLAN_INTERVAL
    joining: float = 0.8
    latent_only: bool = False
    latent_steps: int = 10
    threads: int = 2
    device: str = "cpu"


def run_inspect(options: Inspect) -> dict[str, Any]:
    """Runs the three experiments and looks into the latent space; returns what is written to ``inspect.json``.

    ``imagined`` is the planner alone, ``followed`` the controller alone on recorded states (blind to where objects
    went), ``closed_loop`` both. ``latent`` (:func:`~torchrl_koap.evaluation.latent_space.analyse_latent`) reads labels
    outside the budget, for analysis only.

    Raises:
        ValueError: for fewer than one episode or step, or a run without a planner.
        RunDirectoryError: if the folder is no finished run.
    """
    for name in ("episodes", "latent_steps"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(options, name)}")
    set_up_torch(options.threads, options.device)
    run = RunDirectory(options.run)
    task, planner, controller = load_run(run)
    dataset = options.dataset or run.read_entry("config.json", "dataset")
    data = load_demonstrations(dataset, task, episodes=run.read_entry("config.json", "episodes"))
    if options.latent_only:  # what earlier experiments found stays
        earlier = run.read_json("inspect.json") if (run.path / "inspect.json").exists() else {}
        result = {name: value for name, value in earlier.items() if name != "verdict"}
    elif planner is None:
        method = run.read_entry("config.json", "method")
        raise ValueError(f"method {method!r} is a policy of its own: there are no planner and controller to tell apart")
    else:
        result = _experiments(options, run, task, planner, controller, data)
    result["latent"] = _look_into(options, run, task, controller.cpu(), data)
    result["verdict"] = verdict(result, task)
    run.write_json("inspect.json", result)
    if not options.latent_only:
        plot_inspection(result, task, run.path / FOLDER / "inspect.png")
    if (run.path / "index.html").exists():
        write_report(run.path, draw=False)
    return result


def _experiments(
    options: Inspect, run: RunDirectory, task: Task, planner: StatePlanner, controller: nn.Module, data: TensorDictBase
) -> dict[str, Any]:
    planner, controller = planner.to(options.device), controller.to(options.device)
    settings = {
        "replan_interval": options.replan_interval,
        "joining": options.joining,
        "controller_columns": columns_of(run, task),
        "gripper": task.gripper,
    }
    seeds = list(range(options.seed, options.seed + options.episodes))
    from torchrl_koap.envs.registry import make_env_of  # takes seconds

    make_env = make_env_of(task, num_threads=options.threads)
    _, contexts = choose_contexts(task, options.episodes)
    with tqdm(total=3, desc="experiments", unit="experiment") as bar:
        policy = make_policy(planner, controller, state_columns=task.state_of, **settings)
        closed = roll_out(policy, make_env, seeds, max_steps=task.max_steps, contexts=contexts)
        bar.update()
        followed = follow_recordings(planner, controller, task, data, make_env, episodes=options.episodes, **settings)
        bar.update()
        start = torch.stack([task.state_of(episode["observation"][0]) for episode in closed])
        steps = max(int(trajectory_lengths(data).max() * 1.5), 50)
        imagined = imagine(
            planner, start.to(options.device), interval=options.replan_interval, max_steps=steps, seed=options.seed
        ).cpu()
        bar.update()
    return {
        "imagined": rate(imagined_success(task, imagined)),
        "followed": rate(executed_success(followed)),
        "closed_loop": rate(executed_success(closed)),
        "plan_to_execution": tracking_errors(task, closed, options.replan_interval),
        "recording_to_execution": tracking_errors(task, followed, options.replan_interval),
        "distance_to_demonstrations": coverage(task, closed, data),
    }


def _look_into(
    options: Inspect, run: RunDirectory, task: Task, controller: nn.Module, data: TensorDictBase
) -> dict[str, Any]:
    """What :func:`analyse_latent` finds, drawn as well, or a note for methods without latent actions."""
    if not isinstance(controller, KoopmanInverseDynamics):
        method = run.read_entry("config.json", "method")
        return {"note": f"method {method!r} has no latent actions to look into"}
    labelled = torch.zeros(len(data), dtype=torch.bool)
    if options.dataset is None:
        labelled = budget_of(run).apply(data)[0]["has_action"].squeeze(-1)
    columns = columns_of(run, task)
    parts = {
        name: [place for place, column in enumerate(columns) if part.start <= column < part.stop]
        for name, part in task.state_slices.items()
    }
    parts = {name: places for name, places in parts.items() if places}
    view = controller_view(data, columns)
    result = analyse_latent(controller, view, labelled, parts, horizon=options.latent_steps)
    values = getattr(controller.operator, "eigenvalues", None)
    plot_latent(result, run.path / FOLDER / "latent.png", task=task, eigenvalues=None if values is None else values())
    return result


def verdict(result: dict[str, Any], task: Task) -> str:
    """What the figures say: a sentence on the experiments, if there are any, and one on the latent space."""
    sentences = [_experiments_say(result, task)] if "imagined" in result else []
    latent = result.get("latent", {})
    if "multi_step" in latent:
        sentences.append(_latent_says(latent))
    elif not sentences:
        sentences.append(latent["note"])
    return ". ".join(sentences)


def _latent_says(latent: dict[str, Any]) -> str:
    errors = latent["multi_step"]
    part = next(iter(errors["koopman"]))
    ahead = {model: f"{1e3 * errors[model][part][-1]:.3g} {error_unit(part)}" for model in MODELS}
    outside = latent[OUTSIDE_THE_BUDGET]
    shared = outside["judged_trajectories_in_budget"]
    reservation = f" ({shared} of these {errors['judged_trajectories']} have labels in the budget)" if shared else ""
    probe, own = (min(outside[name]) for name in ("probe_r2", "decoder_r2"))
    return (
        f"{errors['steps']} steps ahead the latent dynamics miss the {part.replace('_', ' ')} by {ahead['koopman']}"
        f" ({ahead['reconstruction']} of mapping back alone), a linear model on raw states by {ahead['linear']},"
        f" standing still by {ahead['copy_last']}. Outside the budget,"
        f" for analysis only: a linear probe on all labels explains {probe:.1%} of the hardest action dimension on"
        f" held-out trajectories, the run's own decoder {own:.1%}{reservation}"
    )


def _experiments_say(result: dict[str, Any], task: Task) -> str:
    """What the three experiments say, in a sentence.

    Where things are pushed or grasped, recorded tool paths do not answer to where the objects went: there the
    controller is judged by how near the tool stays to them.
    """
    imagined, followed, closed = (result[name]["rate"] for name in ("imagined", "followed", "closed_loop"))
    if closed >= 0.9:
        return "nothing to find: the closed loop succeeds"
    parts = []
    if imagined < 0.9:
        parts.append(f"the planner's own imagination reaches the goal in {imagined:.0%} of the episodes only")
    if task.objects:
        off = result["recording_to_execution"][task.position][-1]
        if off > _NEAR:
            parts.append(f"the controller leaves recorded tool paths by {1e3 * off:.0f} mm")
    elif followed < 0.9:
        parts.append(f"the controller follows recorded states to the goal in {followed:.0%} only")
    distance = result["distance_to_demonstrations"]
    if distance and distance["visited_95"] > 2 * distance["demonstrated_95"]:
        parts.append("executed states lie far from every demonstration")
    if parts:
        return "; ".join(parts)
    return "planner and controller work alone, not together: plans answer badly to what was executed"
