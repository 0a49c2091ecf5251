# This source code is licensed under the MIT license found in the LICENSE file.
"""Fits the decoders of trained runs anew, with and without allowing for errors of the plans, and rolls both out.

    python benchmarks/decoder_input_noise.py RUN [RUN ...] --noise 0 1e-8 --seeds 100 1100 2100

Planner, latent actions and labels stay as they are. A row of the table per run and noise; it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from planner_ablations import labels_of
from resumable_table import open_table

from torchrl_koap.data import controller_view
from torchrl_koap.evaluation import EvalConfig, evaluate, load_run
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.runs.weights import save_weights
from torchrl_koap.training.closed_form import fit_closed_form, likely_axes
from torchrl_koap.training.datasets import load_demonstrations

TABLE = Path(__file__).parent / "results" / "decoder_input_noise.csv"
KEYS = ["task", "method", "labels", "training_seed", "input_noise", "seeds"]
COLUMNS = [*KEYS, "penalty", "held_out_error", "by_seed", "successes", "n", "low", "high", "mean_steps"]


def refitted(source: Path, folder: Path, noise: float) -> dict:
    """Copies a run and fits its decoder on the labels it was trained with; returns what the fit found."""
    shutil.copytree(source, folder)
    trained = load_run(folder)
    if not isinstance(trained.controller, KoopmanInverseDynamics):
        raise SystemExit(f"{source}: method {trained.method.name!r} has no Koopman decoder to fit with other noise")
    task = trained.task
    data = load_demonstrations(trained.config["dataset"], task, episodes=trained.config["episodes"])
    labelled, _ = trained.budget.apply(data, command=task.command_columns)
    view = controller_view(labelled, trained.columns, action_targets=task.targets)
    axes = {"shared_axes": task.moved_columns(), "guessed_axes": likely_axes(task, trained.columns)}
    fit = fit_closed_form(trained.controller, view, input_noise=noise, **axes)
    save_weights(folder / "controller.safetensors", trained.controller, {"task": task.name})
    (folder / "digests.json").unlink(missing_ok=True)  # of the weights before
    return fit


def main() -> None:
    """Fits, rolls out and adds the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 1e-8])
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 1100, 2100])
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    done, write = open_table(options.table, COLUMNS, KEYS)
    for run in options.runs:
        config = load_run(run).config
        known = (config["task"], config["method"], labels_of(config), str(config["seed"]))
        for noise in options.noise:
            key = (*known, f"{noise:g}", " ".join(map(str, options.seeds)))
            if key in done:
                continue
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary) / "run"
                fit = refitted(run, folder, noise)
                settings = [EvalConfig(episodes=options.episodes, seed=seed, threads=1) for seed in options.seeds]
                episodes = [evaluate(folder, setting)["episode"] for setting in settings]
            won = [sum(row["outcome"] == "success" for row in rows) for rows in episodes]
            every = [row["steps"] for rows in episodes for row in rows]
            low, high = wilson_interval(sum(won), len(every))
            found = [f"{fit['penalty']:.4g}", fit["held_out_error"], " ".join(map(str, won)), sum(won), len(every)]
            write([*key, *found, round(low, 3), round(high, 3), round(sum(every) / len(every), 1)])


if __name__ == "__main__":
    main()
