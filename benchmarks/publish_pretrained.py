# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes ``pretrained/NAME`` from a run: compact weights, options, and a model card from its evaluation.

    python benchmarks/publish_pretrained.py RUN NAME --seeds 100 1100 2100 --candidates 16

What is evaluated is the compact policy itself, in 60 episodes per seed.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from planner_ablations import row_of

from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.training.pretrained import publish
from torchrl_koap.training.run_directory import RunDirectory

ROOT = Path(__file__).resolve().parents[1] / "pretrained"
CARD = """# {name}

A policy for the task `{task}` in this library's own simulation, trained on **scripted** demonstrations.

| | |
|---|---|
| success | {successes} of {n} episodes, {success:.1%} (95 % Wilson interval {low:.1%} to {high:.1%}) |
| by noise seed | {by_seed} of 60 with {seeds} |
| entropy of the modes | {entropy} |
| mean steps | {mean_steps} ({mean_steps_won} where successful) |
| evaluated | these compact weights, {contexts}, {candidates} candidate plan(s) |
| data | {demonstrations} scripted demonstrations (`{recorded}`) |
| labels | {labels}, method `{method}` |
| planner | {denoiser}, {updates} updates of {batch} windows, training seed {training_seed} |
| training time | {train_seconds} s of one shared CPU core |
| weights | matrices of the planner as bytes with a scale per row, the rest float32 |

Roll it out, films and report included:

    koap eval pretrained:{name} --episodes 60 --seed 100 --out DIR

Made by

    {command}
    python benchmarks/publish_pretrained.py RUN {name} --candidates {candidates}
"""


def main() -> None:
    """Publishes, evaluates what was published, and writes the card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 1100, 2100])
    parser.add_argument("--candidates", type=int, default=1)
    parser.add_argument("--root", type=Path, default=ROOT)
    options = parser.parse_args()
    folder = publish(options.run, options.root / options.name, "", candidates=options.candidates)
    metrics = (folder / "metrics.csv").read_text().splitlines(keepends=True)
    kept = [metrics[0], *metrics[1::5]]  # for the report's curves a fifth of the rows is enough
    (folder / "metrics.csv").write_text("".join(kept))
    with tempfile.TemporaryDirectory() as out:
        results = [
            evaluate(folder, EvalConfig(out=Path(out) / "run", episodes=60, seed=seed, threads=1))
            for seed in options.seeds
        ]
    choices = {"candidates": options.candidates}
    row = row_of(options.run, results, choices, "") | {"name": options.name, "seeds": options.seeds}
    source = RunDirectory(options.run).read_json("config.json").get("planner_from")
    if source:  # the planner was trained by another command
        row["command"] = f"{RunDirectory(source).read_json('config.json')['command']}\n    {row['command']}"
    row["recorded"] = "koap demos --task {task} --episodes {demonstrations} --seed 0".format(**row)
    if row["disturbed"]:
        row["recorded"] += f" --disturbance {row['disturbed']:g}"
    row["contexts"] = "the 60 fixed contexts with every seed" if "contexts" in results[0] else "all from the same start"
    (folder / "README.md").write_text(CARD.format(**row))
    size = sum(file.stat().st_size for file in folder.iterdir())
    print(f"{folder}: {row['successes']} of {row['n']}, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
