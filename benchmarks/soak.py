# This source code is licensed under the MIT license found in the LICENSE file.
"""Plays many episodes of Avoiding in one process and records the memory of the process.

    python benchmarks/soak.py --run quick --episodes 10000 --table benchmarks/results/soak.csv
    python benchmarks/soak.py --run quick --episodes 1000 --batch-size 1000 --table benchmarks/results/soak_wide.csv

``--run quick`` trains a policy of a few kilobytes, whose planning time is negligible compared with the episodes. The
same command resumes where its table ends. The table numbers processes, because memory is measured per process.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
import tyro
from tables import open_table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
from tiny_runs import TINY, koap, write_demonstrations  # noqa: E402

from torchrl_koap import load_policy
from torchrl_koap.envs.registry import make_env
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.runs.run_directory import find_run
from torchrl_koap.tasks import get_task

COLUMNS = ("process", "episodes", "seconds", "resident_mb", "largest_mb")


def resident() -> float:
    """Returns the present memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def largest() -> float:
    """Returns the largest memory of this process so far in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def quick_run(folder: str) -> str:
    """Trains a tiny run, which plans fast and does not solve the task; returns its folder."""
    data = write_demonstrations(Path(folder) / "data")
    if koap("train", "--out", f"{folder}/run", "--dataset", data, *TINY, "--quiet"):
        raise SystemExit("the quick run could not be trained")
    return f"{folder}/run"


def play(episodes: range, batch_size: int, run: str) -> Iterator[tuple[float, ...]]:
    """Yields episodes, seconds and memory after each batch; keeps no episode."""
    task = get_task("avoiding")
    policy, make = load_policy(find_run(run)), partial(make_env, task, max_steps=task.max_steps, noisy=True)
    began = time.perf_counter()
    for first in episodes[::batch_size]:
        seeds = range(first, min(first + batch_size, episodes.stop))
        roll_out(policy, make, seeds, max_steps=task.max_steps, batch_size=batch_size)
        yield seeds.stop, time.perf_counter() - began, resident(), largest()


def main(*, table: Path, run: str = "pretrained:avoiding", episodes: int = 1000, batch_size: int = 50) -> None:
    """Plays the episodes that the table lacks.

    Args:
        table: CSV file that gets a row after each batch.
        run: run directory, pretrained:NAME or quick.
        episodes: episodes in total.
        batch_size: episodes at a time.
    """
    torch.set_num_threads(1)
    done, write = open_table(table, COLUMNS, COLUMNS[:2])
    first, process = max(((int(played), int(number)) for number, played in done), default=(0, 0))
    with tempfile.TemporaryDirectory() as folder:
        for row in play(range(first, episodes), batch_size, quick_run(folder) if run == "quick" else run):
            shown = [process + 1, *(round(value, 2) for value in row)]
            print(*shown, flush=True)
            write(shown)


if __name__ == "__main__":
    tyro.cli(main)
