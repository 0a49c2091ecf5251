# This source code is licensed under the MIT license found in the LICENSE file.
"""How decoded actions answer to small errors of the frames they are decoded from.

    python benchmarks/noise_answers.py runs/stacking --dataset DEMOS --columns 0 1 2

The recorded windows of the last demonstrations, as they are and with white noise on the robot's position; the error of
the decoded actions is told as a share of the recorded ones' size, both root mean squares over the actions of the first
unit, with the action whose error is the largest. Beside it, how far the first step of the run's own plans is from what
was recorded there.

Rows are appended to the table; a run that is there already is left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from resumable_table import open_table
from tensordict import TensorDictBase

from torchrl_koap.data import controller_view
from torchrl_koap.evaluation.trained_run import TrainedRun, load_run
from torchrl_koap.training.action_errors import first_actions
from torchrl_koap.training.datasets import load_demonstrations

TABLE = Path(__file__).parent / "results" / "noise_answers.csv"
COLUMNS = ("task", "run", "method", "demonstrations", "noise_mm", "error", "size", "share", "worst", "plan_error_mm")
EVERY = 37  # steps between the frames that plans are made from


def plan_error(run: TrainedRun, data: TensorDictBase, columns: list[int]) -> float:
    """Root mean square distance of the first planned frame from the recorded one, over some columns."""
    history, episode, state = run.planner.history, data["episode"], data["state"].float()
    last = [i for i in range(history - 1, len(state) - 1, EVERY) if episode[i - history + 1] == episode[i + 1]]
    seen = torch.stack([state[i - history + 1 : i + 1] for i in last])
    plan = run.planner.plan(seen, generator=torch.Generator().manual_seed(0))
    recorded = state[[i + 1 for i in last]]
    return float((plan[:, 0] - recorded)[:, columns].square().mean().sqrt())


def main() -> None:
    """Adds what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--dataset", required=True)
    parser.add_argument(
        "--columns", type=int, nargs="+", default=[0, 1], help="a position in m, of the robot's columns"
    )
    parser.add_argument("--demonstrations", type=int, default=10, help="the last so many")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.1, 0.3, 1.0], help="mm")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    done, write = open_table(options.table, COLUMNS, COLUMNS[:5])
    for path in options.runs:
        run = load_run(path)
        task, method = run.task, run.method.name
        data = load_demonstrations(options.dataset, task)
        data = data[torch.isin(data["episode"], data["episode"].unique()[-options.demonstrations :])]
        view = controller_view(data, run.columns)
        actions = task.action_columns()
        with torch.no_grad():
            ahead = plan_error(run, data, [run.columns[column] for column in options.columns])
        for noise in options.noise:
            facts = (task.name, path.name, method, str(options.demonstrations), str(noise))
            if facts not in done:
                moved = torch.zeros_like(view["state"])
                generator = torch.Generator().manual_seed(0)
                white = torch.randn(len(moved), len(options.columns), generator=generator)
                moved[:, options.columns] = 1e-3 * noise * white.to(moved)
                noisy = view.copy().set("state", view["state"] + moved)
                decoded, recorded, _ = first_actions(run.controller, noisy, data["episode"].unique())
                pair = (decoded - recorded)[:, actions], recorded[:, actions]
                error, size = (float(part.square().mean().sqrt()) for part in pair)
                worst = task.action_names[actions[int(pair[0].square().mean(0).argmax())]]
                write((*facts, f"{error:.5f}", f"{size:.5f}", f"{error / size:.3f}", worst, f"{1e3 * ahead:.2f}"))


if __name__ == "__main__":
    main()
