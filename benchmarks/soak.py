# This source code is licensed under the MIT license found in the LICENSE file.
"""Plays many episodes of Avoiding in one process and watches its memory; raw files by the thousand; a large batch.

python benchmarks/soak.py --episodes 10000 --minutes 10 --table benchmarks/results/soak.csv
python benchmarks/soak.py --episodes 1000 --batch-size 1000      # a thousand environments in one batch
python benchmarks/soak.py --raw-files 5000                       # conversion with a moving bar
python benchmarks/soak.py --run quick                            # a policy of a few kilobytes: episodes are the load
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import gc
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from tiny_runs import TINY, koap, write_demonstrations  # noqa: E402

from torchrl_koap.envs.registry import make_env_of
from torchrl_koap.evaluation import load_policy
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.tasks import get_task
from torchrl_koap.training.pretrained import find_run

COLUMNS = ("episodes", "seconds", "in_use_mb", "resident_mb", "largest_mb")


class _Allocated(ctypes.Structure):
    """What glibc's mallinfo2 returns."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks")
    ] + [("keepcost", ctypes.c_size_t)]


def in_use() -> float:
    """Memory that was asked for and not given back, in MB; the process may hold more, in pieces."""
    gc.collect()
    library = ctypes.CDLL("libc.so.6")
    library.mallinfo2.restype = _Allocated
    found = library.mallinfo2()
    return (found.uordblks + found.hblkhd) / 1e6


def resident() -> float:
    """Memory of this process at present, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def largest() -> float:
    """The most memory this process ever had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def quick_run(folder: str) -> str:
    """A run that was trained for a moment: it fails, and plans in no time."""
    data = write_demonstrations(Path(folder) / "data")
    if koap("train", "--out", f"{folder}/run", "--dataset", data, *TINY, "--quiet"):
        raise SystemExit("the quick run could not be trained")
    return f"{folder}/run"


def play(episodes: int, batch_size: int, run: str, minutes: float) -> Iterator[dict[str, float]]:
    """A row after each batch; nothing of an episode is kept."""
    task = get_task("avoiding")
    policy, make_env = load_policy(find_run(run)), make_env_of(task, num_threads=1)
    began = time.perf_counter()
    for first in range(0, episodes, batch_size):
        seeds = range(first, min(first + batch_size, episodes))
        roll_out(policy, make_env, seeds, max_steps=task.max_steps, batch_size=batch_size)
        seconds = time.perf_counter() - began
        memory = {"in_use_mb": in_use(), "resident_mb": resident(), "largest_mb": largest()}
        row = {"episodes": seeds.stop, "seconds": seconds} | memory
        print(" ".join(f"{row[name]:.0f}" for name in COLUMNS), flush=True)
        yield row
        if seconds > 60 * minutes:
            return


def convert(files: int) -> None:
    """Writes raw files and reads them as a data set, through the command line."""
    with tempfile.TemporaryDirectory() as folder:
        write_demonstrations(Path(folder) / "data", episodes=files, rows=60)
        before, began = largest(), time.perf_counter()
        status = koap("validate", f"{folder}/data")
        print(f"status {status}, {time.perf_counter() - began:.0f} s, {largest() - before:.0f} MB more than before")


def main() -> None:
    """Does what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--batch-size", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=1e9)
    parser.add_argument("--run", default="pretrained:avoiding")
    parser.add_argument("--raw-files", type=int)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.raw_files:
        convert(options.raw_files)
        return
    with tempfile.TemporaryDirectory() as folder:
        run = quick_run(folder) if options.run == "quick" else options.run
        rows = []
        for row in play(options.episodes, options.batch_size, run, options.minutes):
            rows.append({name: round(value, 2) for name, value in row.items()})
            if options.table:
                with options.table.open("w", newline="") as file:
                    writer = csv.DictWriter(file, COLUMNS)
                    writer.writeheader()
                    writer.writerows(rows)


if __name__ == "__main__":
    main()
