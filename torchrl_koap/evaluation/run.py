# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap eval``: closed-loop rollouts of a trained run, scored with intervals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import nn
from tqdm import tqdm

from torchrl_koap.evaluation.rollouts import make_policy, measure_latency, roll_out, rollouts_to_tensors
from torchrl_koap.evaluation.scores import d3il_score, score, stacking_scores
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ChunkedPolicy, StatePlanner
from torchrl_koap.modules.policies.plan_then_control import EXECUTIONS
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.tasks import REPLAN_INTERVAL, Task, get_task
from torchrl_koap.training.builders import (
    build_controller,
    build_diffusion_policy,
    build_planner,
    make_env_of,
    method_named,
    mode_index_of,
    set_up_torch,
)
from torchrl_koap.training.checkpoints import load_weights, save_tensors
from torchrl_koap.training.pretrained import PREFIX, copy_run, find_run
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError


@dataclass
class Eval:
    """Evaluate a trained run in closed loop and write its report.

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME for a trained policy of the repository.
        out: folder to evaluate in instead of the run's own; what the run is made of is copied there.
        episodes: number of rollouts; tasks with contexts take the fixed ones of the evaluation table in turn.
        rollouts_per_context: rollouts in each context; from 2 on the entropy of the modes per context is known.
        seed: seed of the first rollout; the others count on from it.
        execution: "feedback" (decode at every step) or "open_loop" (decode once per plan).
        solver: another solver than in training: ddpm, ddim, dpm++2m, euler, heun.
        solver_steps: another number of solver steps.
        replan_interval: control steps per plan.
        joining: how slowly plans are joined to the present state; 0 turns it off.
        tempo: how much quicker than planned plans are executed; 1 leaves them as they are.
        candidates: plans (of dp: action chunks) sampled whenever one is due, one of which is taken that goes on with
            the one in force (default: as the run says, else 1).
        choice: rule of that choice: "quarter", "typical" or "nearest".
        batch_size: episodes at a time; results do not depend on it.
        contexts_file: a context file of D3IL to take instead of the table.
        task: refuse a run of another task than this.
        threads: torch and simulator threads.
        device: "cpu" or "cuda".
        report: draw the pictures and write the report.
        animate: make an animation of the rollouts for the report.
    """

    run: tyro.conf.Positional[Path]
    out: Path | None = None
    episodes: int = 60
    rollouts_per_context: int = 1
    seed: int = 100
    execution: str = "feedback"
    solver: str | None = None
    solver_steps: int | None = None
    replan_interval: int = REPLAN_INTERVAL
    joining: float = 0.8
    tempo: float = 1.0
    candidates: int | None = None
    choice: str = "quarter"
    batch_size: int | None = None
    contexts_file: Path | None = None
    task: str | None = None
    threads: int = 2
    device: str = "cpu"
    report: bool = True
    animate: bool = True


def load_run(run: RunDirectory, task: str | None = None) -> tuple[Task, StatePlanner | None, nn.Module]:
    """Planner and controller of a finished run, in evaluation mode; a diffusion policy has no planner beside it.

    Raises:
        RunDirectoryError: if the folder is no finished run, or one of another task than asked for.
        CheckpointError: if weights are damaged, of another task or without their statistics.
    """
    trained_on, *parts = (run.read_entry("config.json", name) for name in ("task", "planner", "controller"))
    if task is not None and task != trained_on:
        raise RunDirectoryError(f"{run.path} was trained on task {trained_on!r}, not on {task!r}")
    facts = get_task(trained_on)
    modules: dict[str, nn.Module] = {}
    if method_named(parts[1]).acts:
        modules["controller"] = build_diffusion_policy(
            parts[0], facts.state_dim, facts.action_dim, facts.planner_features()
        )
    else:
        modules["planner"] = build_planner(parts[0], facts.state_dim, facts.planner_features())
        modules["controller"] = build_controller(parts[1], len(columns_of(run, facts)), facts.action_dim)
    for name, module in modules.items():
        load_weights(run.path / f"{name}.safetensors", module.eval(), task=facts.name)
    return facts, modules.get("planner"), modules["controller"]


def columns_of(run: RunDirectory, task: Task) -> tuple[int, ...]:
    """State columns that the controller of a run reads."""
    return task.controller_columns(run.read_entry("config.json", "controller").get("state", "all"))


def choose_contexts(
    task: Task, episodes: int, rollouts_per_context: int = 1, contexts_file: Path | None = None
) -> tuple[list[int] | None, np.ndarray | None]:
    """Number of the context of every rollout, and the contexts; None for a task in which all episodes start alike."""
    if not task.objects:
        given = {"contexts_file": contexts_file is not None, "rollouts_per_context": rollouts_per_context != 1}
        for name, unfit in given.items():
            if unfit:
                raise ValueError(f"{name} was given, but task {task.name!r} has no contexts")
        return None, None
    from torchrl_koap.envs.contexts import evaluation_contexts, load_contexts  # takes seconds

    if contexts_file is None:
        table = evaluation_contexts(task)
    else:
        table = load_contexts(contexts_file, task)
    numbers = [episode // rollouts_per_context for episode in range(episodes)]
    if numbers[-1] >= len(table):
        raise ValueError(
            f"{episodes} episodes with {rollouts_per_context} per context need {numbers[-1] + 1}"
            f" contexts, there are {len(table)}"
        )
    return numbers, table[numbers]


def run_eval(options: Eval) -> dict[str, Any]:
    """Evaluates; returns what is written to ``eval.json``.

    Raises:
        ValueError: for unknown options or fewer than one episode.
    """
    for name in ("episodes", "batch_size", "rollouts_per_context"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    lookup(EXECUTIONS, options.execution, "execution")
    set_up_torch(options.threads, options.device)
    source = find_run(options.run)
    if options.out is None and str(options.run).startswith(PREFIX):
        raise ValueError(f"{options.run} is evaluated in a folder of your own: name it with --out")
    if options.task is not None:  # before anything is copied
        load_run(RunDirectory(source), options.task)
    run = RunDirectory(source if options.out is None else copy_run(source, options.out))
    task, planner, controller = load_run(run, options.task)
    sampler = controller if planner is None else planner
    if options.solver is not None:
        sampler.solver = options.solver
    if options.solver_steps is not None:
        sampler.num_steps = options.solver_steps
    candidates = options.candidates
    if candidates is None:
        candidates = run.read_json("config.json").get("candidates") or 1
    if planner is None:
        policy = ChunkedPolicy(
            controller,
            state_columns=task.state_of,
            history=controller.history,
            replan_interval=options.replan_interval,
            candidates=candidates,
            choice=options.choice,
        )
    else:
        policy = make_policy(
            planner,
            controller,
            state_columns=task.state_of,
            execution=options.execution,
            replan_interval=options.replan_interval,
            joining=options.joining,
            tempo=options.tempo,
            controller_columns=columns_of(run, task),
            gripper=task.gripper,
            candidates=candidates,
            choice=options.choice,
        )
    policy = policy.to(options.device)
    seeds = list(range(options.seed, options.seed + options.episodes))
    numbers, contexts = choose_contexts(task, options.episodes, options.rollouts_per_context, options.contexts_file)
    mode_index = mode_index_of(task)
    with tqdm(total=options.episodes, desc="rollouts", unit="episode") as bar:
        episodes = roll_out(
            policy,
            make_env_of(task, num_threads=options.threads),
            seeds,
            max_steps=task.max_steps,
            batch_size=options.batch_size,
            contexts=contexts,
            progress=lambda finished: bar.update(finished - bar.n),
        )
    unsolved = "zero" if task.entropy == "contexts" else "skip"
    result = score(
        episodes, seeds, num_modes=task.num_modes, mode_index=mode_index, contexts=numbers, unsolved=unsolved
    )
    if task.source == "stacking":
        result |= stacking_scores(episodes, numbers, complete=task.name == "stacking")
    result |= d3il_score(task, result)
    rows = result.pop("episode")
    result |= measure_latency(policy, task.observation_dim)
    result |= {
        "execution": "chunks" if planner is None else options.execution,
        "solver": sampler.solver,
        "solver_steps": sampler.num_steps,
        "replan_interval": options.replan_interval,
        "joining": options.joining,
        "tempo": options.tempo,
        "candidates": candidates,
        "episode": rows,
    }
    rollouts = rollouts_to_tensors(
        [episode.cpu() for episode in episodes],
        position=task.observation[task.position],
        mode_index=mode_index,
        interval=options.replan_interval,
        objects=[task.observation[part] for part in task.drawn.values()],
        plans_position=task.plans_position,
    )
    if contexts is not None:  # in full precision: a film of the same episode starts from it
        rollouts["context"] = torch.from_numpy(contexts)
    save_tensors(run.path / "rollouts.safetensors", rollouts, {"task": task.name})
    run.write_json("eval.json", result)
    if options.report:
        write_report(run.path, animation=options.animate)
    return result
