# This source code is licensed under the MIT license found in the LICENSE file.
"""How well a controller follows a perfect plan: the recorded future of demonstrations, with and without blending.

    python benchmarks/tracking.py RUN --dataset DIR

The planner takes no part: at every step the plan is what the demonstration did next, so all error is the controller's.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from torchrl_koap.data import trajectory_lengths
from torchrl_koap.envs.registry import make_env_of
from torchrl_koap.evaluation.trained_run import load_run
from torchrl_koap.modules import blend_plan, policy_transforms
from torchrl_koap.training.datasets import load_demonstrations


@torch.no_grad()
def follow(
    task, controller, paths: list[torch.Tensor], blend_decay: float, steps: int, horizon: int = 14
) -> list[float]:
    """Mean distance (mm) to the demonstration after each step, over the episodes that still run."""
    history = controller.num_past + 1
    env = TransformedEnv(make_env_of(task)(len(paths)), policy_transforms(history))
    td, running, errors = env.reset(), torch.ones(len(paths), dtype=torch.bool), []
    columns = list(task.state_columns)
    for step in range(steps):
        observed = td["observation_history"][..., columns]
        # the state seen before step t is row t - 1 of a demonstration (row 0 repeats the start)
        rows = torch.arange(step, step + horizon)
        plan = torch.stack([path[rows.clamp_max(len(path) - 1)] for path in paths])
        window = torch.cat([observed, blend_plan(observed, plan, blend_decay)], 1)
        action = controller(TensorDict({"state": window}, batch_size=[len(paths)]))["action"]
        td = env.step(td.set("action", action[:, history - 1]))
        running &= ~td["next", "done"].squeeze(-1)
        wanted = torch.stack([path[min(step, len(path) - 1)] for path in paths])
        distance = (td["next", "observation"][..., columns] - wanted).norm(dim=-1)
        errors.append(distance[running].mean().item() * 1e3)
        td = step_mdp(td)
    env.close()
    return errors


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories whose controllers are tried")
    parser.add_argument("--dataset", default="scripted")
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--steps", type=int, nargs="+", default=[12, 30, 48])
    arguments = parser.parse_args()
    print(f"{'run':<20}{'blend_decay':>12}" + "".join(f"{f'step {step}':>12}" for step in arguments.steps) + "   (mm)")
    for run in arguments.runs:
        trained = load_run(run)
        task, controller = trained.task, trained.controller
        data = load_demonstrations(arguments.dataset, task)
        paths = data["state"].split(trajectory_lengths(data).tolist())[: arguments.episodes]
        for blend_decay in (0.0, 0.8):
            errors = follow(task, controller, list(paths), blend_decay, max(arguments.steps) + 1)
            print(f"{run.name:<20}{blend_decay:>12}" + "".join(f"{errors[step]:>12.1f}" for step in arguments.steps))


if __name__ == "__main__":
    main()
