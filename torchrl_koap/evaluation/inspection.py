# This source code is licensed under the MIT license found in the LICENSE file.
"""Finds which part of a trained run fails (planner, controller or data), and what its latent actions hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.evaluation.closed_loop import RolloutEnvironment, find_environment
from torchrl_koap.evaluation.config import EvalConfig
from torchrl_koap.evaluation.diagnosis import (
    distance_to_demonstrations,
    follow_recordings,
    left_recordings,
    of_position,
    planner_rollout,
    tracking_errors,
)
from torchrl_koap.evaluation.findings import GOOD, NEAR, describe_inspection
from torchrl_koap.evaluation.latent_space import analyse_latent
from torchrl_koap.evaluation.policies import trained_policy
from torchrl_koap.evaluation.rollout_faults import start_faults
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.evaluation.scores import outcome_of
from torchrl_koap.evaluation.statistics import rate
from torchrl_koap.keys import HAS_ACTION
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.runs.config import given_options
from torchrl_koap.runs.device import default_threads, set_up_torch, torch_as_before
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.runs.run_directory import RunDirectory, writable_folder
from torchrl_koap.training.trained import Trained


@dataclass
class InspectConfig(EvalConfig):
    """Which part of a trained run fails, and what its latent actions hold.

    The controller is tested alone only where an environment starts as recordings did: not in Gymnasium, and not if it
    draws goals that are no bodies of the task.

    Attributes:
        latent_only: analyse the latent space only, which takes seconds, without experiments in the simulator.
    """

    episodes: int = 30
    seed: int = 500
    latent_only: bool = False


@torch_as_before()
def inspect(run: str | Path, config: InspectConfig | None = None) -> dict[str, Any]:
    """Runs the three experiments and analyses the latent space; writes ``inspect.json``.

    ``planner_alone`` takes plans as executed states; it needs a goal in the states of the task. ``controller_alone``
    follows recorded states, whatever happens to objects; ``both`` is the closed loop. Plans are executed as in
    ``koap eval``. ``latent`` (:func:`~torchrl_koap.evaluation.latent_space.analyse_latent`) reads labels outside the
    budget, for evaluation only.

    Args:
        run (str or Path): a run directory, or ``"pretrained:NAME"``.
        config (InspectConfig, optional): the options.

    Returns:
        dict: the contents of ``inspect.json``: the three experiments, if they ran, ``latent``, and ``findings``.

    Raises:
        ValueError: for a run without a planner, a task without an environment, or if all episodes raise errors.
        RunDirectoryError: if the folder is no finished run, or its demonstrations are missing or changed.

    Examples:
        >>> from torchrl_koap.evaluation import InspectConfig, inspect
        >>> inspect("runs/koap", InspectConfig(latent_only=True))["findings"]  # doctest: +SKIP
    """
    config = given_options(config, InspectConfig)
    set_up_torch(config.threads or default_threads(), config.device)
    trained = Trained.load(run, plugins=config.plugins)
    task = trained.task
    if task.env is None and config.env is None and not config.latent_only:
        raise ValueError(
            f"task {task.name!r} has no environment to make experiments in: name one with --env, or analyse the latent"
            " space alone with --latent-only; `koap eval` measures plans and actions on recorded data"
        )
    if trained.planner is None and not config.latent_only:
        raise ValueError(f"method {trained.method.name!r} samples actions: it has no planner and controller to compare")
    if config.out is None:
        writable_folder(run)  # refuses a pretrained run before its data are read
    data = trained.data(config.dataset)
    labelled = trained.hide_labels(data)[0][HAS_ACTION].squeeze(-1)
    where = None if config.latent_only else find_environment(task, config, trained.cameras)
    directory = RunDirectory(writable_folder(run, config.out))  # after all checks: a refused call copies nothing
    if where is not None:
        result = _experiments(config, trained, data, where)
    else:  # keeps the results of earlier experiments
        result = directory.read_json("inspect.json") if (directory.path / "inspect.json").exists() else {}
    result["latent"] = _analyse(trained, data, labelled)
    result["findings"] = describe_inspection(result, task)
    directory.write_json("inspect.json", result)
    return result


def _experiments(
    config: InspectConfig, trained: Trained, data: TensorDictBase, where: RolloutEnvironment
) -> dict[str, Any]:
    task = trained.task
    planner = trained.planner.to(config.device)
    policy = trained_policy(trained, config.execution).to(config.device)
    interval = policy.execution.replan_interval
    seeds = list(range(config.seed, config.seed + config.episodes))
    found: dict[str, Any] = {} if config.env is None else {"env": config.env}
    at_once = config.num_envs or config.batch_size
    options = {"max_steps": where.max_steps, "contexts": where.contexts, "batch_size": at_once}
    with progress_bar(3, "experiments", unit="experiment") as bar:
        closed = roll_out(policy, where.make_env, seeds, **options)
        bar.update()
        found["both"] = rate([outcome_of(episode) == "success" for episode in closed])
        if not (closed := [episode for episode in closed if outcome_of(episode) != "error"]):
            raise ValueError(f"every episode ended with an error of the environment: {where.record.faults()[-1]}")
        found |= {
            "plan_to_execution": tracking_errors(task, closed, interval),
            "distance_to_demonstrations": distance_to_demonstrations(task, closed, data),
        }
        if config.env is None and (
            followed := follow_recordings(policy, task, data, where.make_env, episodes=config.episodes)
        ):
            tracked = tracking_errors(task, followed, interval)
            if task.objects and of_position(task, tracked):
                left = left_recordings(task, followed, interval, beyond=NEAR)
                found["recordings_left"] = {"count": left, "episodes": len(followed)}
            found["controller_alone"] = rate([outcome_of(episode) == "success" for episode in followed])
            found["recording_to_execution"] = tracked
        bar.update()
        if task.goal is not None:
            start = torch.stack([task.state_of(episode["observation"][0]) for episode in closed]).to(config.device)
            steps = max(int(trajectory_lengths(data).max() * 1.5), 50)
            planned = planner_rollout(planner, start, interval=interval, max_steps=steps, seed=config.seed).cpu()
            found["planner_alone"] = rate(task.goal_reached(planned).any(-1).tolist())
        bar.update()
    if where.record is not None:
        elsewhere = start_faults(closed, data, task) if found["both"]["rate"] < GOOD else []
        if faults := [*where.record.faults(), *elsewhere]:
            found["faults"] = faults
    return found


def _analyse(trained: Trained, data: TensorDictBase, labelled: Tensor) -> dict[str, Any]:
    controller, task = trained.controller.cpu(), trained.task
    if not isinstance(controller, KoopmanInverseDynamics):
        return {"note": f"method {trained.config.method!r} has no latent actions to analyse"}
    parts = {
        name: places
        for name, part in task.state_slices.items()
        if (places := [place for place, column in enumerate(trained.columns) if part.start <= column < part.stop])
    }
    return analyse_latent(controller, trained.seen(data), labelled, parts)
