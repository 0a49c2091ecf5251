# This source code is licensed under the MIT license found in the LICENSE file.
"""Action errors of controllers on every task, without planner and simulator: is the inverse dynamics the limit?

    python benchmarks/action_errors.py --tasks aligning sorting stacking --methods koap linear --fractions 0.01 0.02

RMSE of the first decoded action (in mm, mrad for joints) on demonstrations of which no action was in the budget; labels
on whole trajectories. Mean over seeds and their range; the difference to KOAP is paired by seed (the same labels), with
a 95 % t-interval. The hidden actions are read for this table only.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

import torch
from scipy.stats import t as student

from torchrl_koap.data import LabelBudget, controller_view
from torchrl_koap.runs.device import set_up_torch
from torchrl_koap.tasks import get_task
from torchrl_koap.training import RunDirectory, TrainConfig, load_demonstrations, resolve
from torchrl_koap.training.action_errors import UNITS, hidden_action_errors, rmse_mm
from torchrl_koap.training.controller import train_controller


def action_error(task, data, method: str, fraction: float, seed: int, updates: int) -> float:
    """Error of one controller, trained as ``koap train`` does."""
    labelled, _ = LabelBudget(fraction, seed=seed).apply(data, command=task.command_columns)
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig(out=Path(folder), task=task.name, method=method, seed=seed, controller_steps=updates)
        resolved = resolve(config)
        torch.manual_seed(seed)
        controller, _, _ = train_controller(RunDirectory(folder), resolved, labelled)
    predicted, true = hidden_action_errors(controller, controller_view(data, resolved.columns), labelled)
    same = task.action_columns()  # a gripper's number has no unit
    return rmse_mm(predicted[:, same], true[:, same])


def paired(first: list[float], second: list[float]) -> str:
    """Mean difference with its 95 % interval."""
    differences = [a - b for a, b in zip(first, second, strict=True)]
    mean = statistics.fmean(differences)
    if len(differences) < 2:
        return f"{mean:+.3f}"
    half = student.ppf(0.975, len(differences) - 1) * statistics.stdev(differences) / len(differences) ** 0.5
    return f"{mean:+.3f} ({mean - half:+.3f} to {mean + half:+.3f})"


def main() -> None:
    """Prints the table, a row as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["aligning", "sorting", "stacking"])
    parser.add_argument("--methods", nargs="+", default=["koap", "koap_labelled_only", "linear", "dd_lookahead"])
    parser.add_argument("--fractions", nargs="+", type=float, default=[0.01, 0.02])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=500)
    parser.add_argument("--episodes", type=int, help="scripted demonstrations (default: those of the task)")
    parser.add_argument("--datasets", nargs="*", default=[], help="TASK=FOLDER, instead of recording")
    options = parser.parse_args()
    set_up_torch(1, "cpu")
    folders = dict(item.split("=", 1) for item in options.datasets)
    print(
        "| task | labels | method | error, mean (range) | difference to koap (95 %) |\n|---|---|---|---|---|",
        flush=True,
    )
    for name in options.tasks:
        task = get_task(name)
        data = load_demonstrations(folders.get(name, "scripted"), task, episodes=options.episodes)
        for fraction in options.fractions:
            known: dict[str, list[float]] = {}
            for method in options.methods:
                values = [action_error(task, data, method, fraction, seed, options.updates) for seed in options.seeds]
                known[method] = values
                beside = paired(values, known["koap"]) if method != "koap" and "koap" in known else ""
                spread = f"{statistics.fmean(values):.3f} ({min(values):.3f}-{max(values):.3f})"
                unit = UNITS[task.action_unit]
                print(f"| {name} | {fraction:.0%} | {method} | {spread} {unit} | {beside} |", flush=True)


if __name__ == "__main__":
    main()
