# This source code is licensed under the MIT license found in the LICENSE file.
"""Trains a seven-joint robot from arrays with few labels for about a minute and tests it on new goals.

    python benchmarks/own_robot.py --write

Joints follow delta commands with a lag. There are 50 demonstrations from random positions to random goals, 5 of them
with actions. The trained policy then moves ten robots to goals that no demonstration had. ``--write`` writes
``benchmarks/results/own_robot.csv``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tables import write_table

from torchrl_koap import (
    Agent,
    EvalConfig,
    PlannerConfig,
    RunConfig,
    TrainConfig,
    Trained,
    evaluate,
    load_policy,
    train,
)
from torchrl_koap.data import make_demonstrations, save_ted, select_state
from torchrl_koap.evaluation.data_errors import first_actions
from torchrl_koap.modules import LinearInverseDynamics
from torchrl_koap.training.closed_form import fit_closed_form

RESULTS = Path(__file__).resolve().parent / "results" / "own_robot.csv"
JOINTS, DEMONSTRATIONS, LABELLED, FRAMES = 7, 50, 5, 60
REACHED = 0.05  # rad, largest distance of any joint to its goal
NAMES = [f"q{joint + 1}" for joint in range(JOINTS)] + [f"goal{joint + 1}" for joint in range(JOINTS)]


class Arm:
    """A batch of arms with random positions and goals."""

    def __init__(self, count: int, generator: np.random.Generator):
        self.joints, self.goals = generator.uniform(-1, 1, (2, count, JOINTS))
        self.speed = np.zeros((count, JOINTS))

    def observe(self) -> np.ndarray:
        """Returns joints and goals ``[count, 14]`` (rad)."""
        return np.concatenate([self.joints, self.goals], 1)

    def step(self, action: np.ndarray) -> None:
        """Applies delta commands ``[count, 7]`` (rad), which the joints follow with a lag."""
        self.speed = 0.6 * self.speed + 0.4 * action
        self.joints = self.joints + self.speed


def record(seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Records demonstrations; returns frames ``[60, 14]`` and actions ``[60, 7]`` of each."""
    generator = np.random.default_rng(seed)
    arm, states, actions = Arm(DEMONSTRATIONS, generator), [], []
    for _ in range(FRAMES):
        states.append(arm.observe())
        actions.append(0.15 * (arm.goals - arm.joints) + generator.normal(0, 0.002, arm.joints.shape))
        arm.step(actions[-1])
    return list(np.stack(states, 1)), list(np.stack(actions, 1))


def drive(run: Path, seed: int, steps: int = 200) -> np.ndarray:
    """Rolls out ten arms; returns the goal distance of each arm's worst joint after ``steps`` steps (rad)."""
    arm, agent = Arm(10, np.random.default_rng(1000 + seed)), Agent(load_policy(run), seed=seed)
    agent.reset()
    for _ in range(steps):
        arm.step(agent.act(arm.observe()))
    return np.abs(arm.goals - arm.joints).max(1)


def action_errors(run: Path, states: list[np.ndarray], actions: list[np.ndarray]) -> tuple[float, float]:
    """Returns the action errors of controller and ridge on the demonstrations without labels (rad)."""
    trained = Trained.load(run)
    every, few = (
        trained.seen(select_state(data, task.state_of))
        for data, task in (
            make_demonstrations(states, part, control_hz=30, robot=range(JOINTS)) for part in (actions, _few(actions))
        )
    )
    ridge = LinearInverseDynamics(JOINTS, JOINTS).to(every["state"].dtype)
    fit_closed_form(ridge, few)
    errors = []
    for model in (trained.controller, ridge):
        predicted, true, _ = first_actions(model, every, range(LABELLED, DEMONSTRATIONS))
        errors.append((predicted - true).square().mean().sqrt().item())
    return errors[0], errors[1]


def _few(actions: list[np.ndarray]) -> list[np.ndarray | None]:
    return [taken if index < LABELLED else None for index, taken in enumerate(actions)]


def measure(options: argparse.Namespace, seed: int, folder: Path) -> dict[str, Any]:
    """Records, trains, evaluates and rolls out once; returns a row."""
    states, actions = record(seed)
    data, task = make_demonstrations(
        states,
        _few(actions),
        control_hz=30,
        state_names=NAMES,
        state_units="rad",
        action_units="rad",
        robot=NAMES[:JOINTS],
    )
    save_ted(data, folder / "arm" / "ted", task=task)
    run = folder / "run"
    asked = {"planner": PlannerConfig(steps=options.steps), "run": RunConfig(seed=seed)}
    summary = train(TrainConfig(dataset=str(folder / "arm"), out=run, **asked)).results
    result = evaluate(run, EvalConfig(threads=1))
    error, ridge = action_errors(run, states, actions)
    away = drive(run, seed)
    return {
        "seed": seed,
        "demonstrations": DEMONSTRATIONS,
        "labelled": LABELLED,
        "joints": JOINTS,
        "updates": options.steps,
        "train_seconds": f"{sum(summary['train_seconds'].values()):.0f}",
        "goals_reached": int((away < REACHED).sum()),
        "goals": len(away),
        "worst_distance_rad": f"{away.max():.3f}",
        "action_error_rad": f"{error:.5f}",
        "ridge_error_rad": f"{ridge:.5f}",
        "relative_plan_error": f"{result['relative_plan_error']:.4f}",
    }


def main() -> None:
    """Prints a row per training seed and, with ``--write``, writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=800, help="updates of the planner")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(options, seed, Path(folder)))
        print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if options.write:
        write_table(RESULTS, rows)


if __name__ == "__main__":
    main()
