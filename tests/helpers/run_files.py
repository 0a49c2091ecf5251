# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes small run directories for the tests of pictures and report."""

import json
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from safetensors.numpy import save_file

from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import get_task

LABELS = {
    "unit": "trajectory",
    "selected_units": 1,
    "total_units": 2,
    "labelled_transitions": 20,
    "total_transitions": 40,
    "available_transitions": 40,
    "trajectories_touched": 1,
    "total_trajectories": 2,
    "seed": 7,
}
_MODELS = {"controller": 0.00091, "ridge": 0.00104, "mean_action": 0.003}
ERRORS = {
    "labels": 20,
    "trajectories": 1,
    "unit": [{"unit": "m", "columns": ["x", "y"], **_MODELS}],
    "column": [{"name": name, "unit": "m", **_MODELS} for name in "xy"],
}
EVALUATION = {
    "rates": {"success": {"rate": 0.5, "low": 0.15, "high": 0.85, "episodes": 4}},
    "mode_entropy": 0.218,
    "distinct_modes": 2,
    "collisions": 1,
    "mean_steps": 19.5,
    "episodes": 4,
    "plan_ms": 8.5,
    "control_ms": 0.5,
    "control_hz": 400.0,
    "action_errors_on": "outside_budget",
    "labels_read_outside_budget": 20,
    "action_errors": {"outside_budget": ERRORS},
    "execution": {"strategy": "feedback", "replan_interval": 4},
    "episode": [{"seed": 100 + e, "outcome": "success", "mode": e, "steps": 20} for e in range(4)],
}


def run_of(task: str | None, folder: Path = Path("run"), **numbers) -> RunFacts:
    return RunFacts(folder, None if task is None else get_task(task), **numbers)


def make_rollouts(episodes: int = 4, steps: int = 20) -> dict[str, np.ndarray]:
    """Makes straight paths side by side from start to finish line; the last two collide and time out."""
    share = np.linspace(0, 1, steps)[:, None]
    start, goals = np.array([0.525, -0.28]), np.stack([np.linspace(0.26, 0.72, episodes), np.full(episodes, 0.36)], 1)
    position = start + share * (goals[:, None] - start)
    length = np.full(episodes, steps)
    length[-1] = steps // 2
    position[-1, steps // 2 :] = np.nan
    plan = np.full((episodes, steps // 4, 14, 2), np.nan)
    plan_step = np.full((episodes, steps // 4), -1)
    for row in range(steps // 4 - 1):
        plan[:, row, :4] = position[:, 4 * row + 1 : 4 * row + 5]
        plan_step[:, row] = 4 * row
    outcome = np.array([1] * (episodes - 2) + [0, 2])
    mode = np.where(outcome == 1, np.arange(episodes), -1)
    return {
        "position": position,
        "length": length,
        "mode": mode,
        "outcome": outcome,
        "plan": plan,
        "plan_step": plan_step,
    }


def make_object_rollouts(task: str, episodes: int = 4, steps: int = 20) -> dict[str, np.ndarray]:
    """Extends :func:`make_rollouts` by contexts and by bodies that are pushed 0.3 m."""
    facts = get_task(task)
    rollouts = {key: value[:episodes] for key, value in make_rollouts(max(episodes, 4), steps).items()}
    number, generator = len(facts.bodies), np.random.default_rng(0)
    start = np.array([0.4, -0.2]) + 0.2 * generator.random((episodes, number, 2))
    moved = np.linspace(0, 0.3, steps)[:, None, None] * np.array([0.0, 1.0])
    rollouts["object_position"] = start[:, None] + moved  # [E, T, bodies, 2]
    rollouts["object_position"][np.isnan(rollouts["position"]).any(-1)] = np.nan
    rollouts["context"] = np.concatenate([start, generator.random((episodes, number, 1))], -1)
    rollouts["action"] = np.zeros((episodes, steps, facts.action_dim))
    return rollouts


def make_demonstrations() -> dict[str, np.ndarray]:
    """Makes two straight demonstrations of 20 steps, the first one labelled."""
    y = np.linspace(-0.28, 0.36, 20)
    position = np.concatenate([np.stack([np.full(20, x), y], 1) for x in (0.3, 0.7)])
    episode = np.arange(2).repeat(20)
    return {"position": position, "episode": episode, "labelled": episode == 0, "mode": np.array([0, 23])}


def write_run(folder: Path) -> Path:
    config = {"task": "avoiding", "method": "koap", "preset": "default", "seed": 0, "sizes": {"planner": [32, 64]}}
    config |= {"command": "koap train --out 'a folder'", "versions": {"torch": "2.13.0"}}
    summary = {"labels": LABELS, "planner_parameters": 812345, "train_seconds": {"planner": 65.0, "controller": 20.0}}
    for name, content in (("config", config), ("summary", summary), ("eval", EVALUATION)):
        (folder / f"{name}.json").write_text(json.dumps(content))
    head = "phase,step,loss_planner,loss_reconstruction,loss_koopman,loss_action,learning_rate,iterations_per_second\n"
    rows = [f"planner,{step},{1 / step},,,,0.001,30\n" for step in range(1, 50)]
    rows += [f"controller,{step},,{1 / step},{2 / step},0,0.001,30\n" for step in range(1, 50)]
    (folder / "metrics.csv").write_text(head + "".join(rows))
    true = np.random.default_rng(0).normal(size=(20, 2)) * 0.005
    save_file(make_rollouts(), folder / "rollouts.safetensors")
    save_file(make_demonstrations(), folder / "demonstrations.safetensors")
    save_file({"predicted": true + 0.001, "true": true}, folder / "actions.safetensors")
    return folder


def titles(figure) -> list[str]:
    """Returns the titles of a figure's panels."""
    return [axes.get_title(loc="left") for axes in figure.axes]


def drawn_lines(axes) -> list[np.ndarray]:
    return [line for item in axes.collections if isinstance(item, LineCollection) for line in item.get_segments()]
