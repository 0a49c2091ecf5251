# This source code is licensed under the MIT license found in the LICENSE file.
"""Plays many episodes of Avoiding in one process and watches its memory; raw files by the thousand; a large batch.

python benchmarks/soak.py --run quick --episodes 10000 --table benchmarks/results/soak.csv
python benchmarks/soak.py --run quick --episodes 1000 --batch-size 1000 --table benchmarks/results/soak_wide.csv
python benchmarks/soak.py --raw-files 500 2500 5000 10000 --table benchmarks/results/soak_raw.csv

``--run quick`` is a policy of a few kilobytes that plans in no time: episodes are the load. The same command goes on
where its table ends, in a process that has a number of its own there, as its memory is its own.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import ctypes
import gc
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from raw_episodes import write_raw_episode  # noqa: E402
from tiny_runs import TINY, demonstration, koap, write_demonstrations  # noqa: E402

from torchrl_koap.data import open_dataset
from torchrl_koap.envs.registry import make_env_of
from torchrl_koap.evaluation import load_policy
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.files import replacing_file
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.tasks import get_task

COLUMNS = ("process", "episodes", "seconds", "in_use_mb", "resident_mb", "largest_mb")
RAW_COLUMNS = ("files", "steps", "seconds", "data_mb", "convert_mb", "validate_mb")


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


def anonymous() -> float:
    """Memory of this process that is no part of a file on disk, in MB: what a machine must have."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["RssAnon"].split()[0]) / 1e3


def largest() -> float:
    """The most memory this process ever had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def quick_run(folder: str) -> str:
    """A run that was trained for a moment: it fails, and plans in no time."""
    data = write_demonstrations(Path(folder) / "data")
    if koap("train", "--out", f"{folder}/run", "--dataset", data, *TINY, "--quiet"):
        raise SystemExit("the quick run could not be trained")
    return f"{folder}/run"


def play(episodes: range, batch_size: int, run: str, minutes: float) -> Iterator[dict[str, float]]:
    """A row after each batch; nothing of an episode is kept."""
    task = get_task("avoiding")
    policy, make_env = load_policy(find_run(run)), make_env_of(task, num_threads=1)
    began = time.perf_counter()
    for first in episodes[::batch_size]:
        seeds = range(first, min(first + batch_size, episodes.stop))
        roll_out(policy, make_env, seeds, max_steps=task.max_steps, batch_size=batch_size)
        seconds = time.perf_counter() - began
        memory = {"in_use_mb": in_use(), "resident_mb": resident(), "largest_mb": largest()}
        yield {"episodes": seeds.stop, "seconds": seconds} | memory
        if seconds > 60 * minutes:
            return


def soak(options: argparse.Namespace) -> None:
    """Plays what the table does not hold yet."""
    done = read(options.table)
    first, process = (int(done[-1]["episodes"]), int(done[-1]["process"]) + 1) if done else (0, 1)
    with tempfile.TemporaryDirectory() as folder:
        run = quick_run(folder) if options.run == "quick" else options.run
        for row in play(range(first, options.episodes), options.batch_size, run, options.minutes):
            done.append({"process": process} | {name: round(value, 2) for name, value in row.items()})
            print(" ".join(f"{float(done[-1][name]):.0f}" for name in COLUMNS), flush=True)
            write(options.table, COLUMNS, done)


@contextlib.contextmanager
def watching_memory() -> Iterator[list[float]]:
    """The most memory in MB that is not a file's within the block, its first entry; looked at every 5 ms."""
    found, ended = [anonymous()], threading.Event()

    def look() -> None:
        while not ended.wait(0.005):
            found[0] = max(found[0], anonymous())

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield found
    finally:
        ended.set()
        watcher.join()


def convert(files: int) -> dict[str, float]:
    """Writes raw files of 60 to 99 rows; memory that their conversion takes, and their check, which reads them all."""
    lengths = [60 + index % 40 for index in range(files)]
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "data"
        for index, rows in enumerate(lengths):
            commanded, measured = demonstration(index % 8, rows)
            paths = {"des_c_pos": commanded, "c_pos": measured + 1e-7 * index}  # no episode is there twice
            paths = {name: np.pad(path, ((0, 0), (0, 1)), constant_values=0.12) for name, path in paths.items()}
            write_raw_episode(written / f"env_{index:05d}_00.pkl", paths)
        before, began = anonymous(), time.perf_counter()
        with watching_memory() as converting, progress_bar(None, "demonstrations", unit="episode", delay=0) as bar:
            data, _ = open_dataset(written, progress=count_up_to(bar))
        seconds = time.perf_counter() - began
        row = {"files": files, "steps": len(data), "seconds": seconds, "data_mb": data.bytes() / 1e6}
        with watching_memory() as checking:
            if koap("validate", written, "--task", "avoiding"):
                raise SystemExit("koap validate found something")
    return row | {"convert_mb": converting[0] - before, "validate_mb": checking[0] - before}


def convert_each(options: argparse.Namespace) -> None:
    """A process for each number of files: what one leaves behind would be free for the next."""
    if len(options.raw_files) == 1:
        rows = [*read(options.table), {name: round(value, 1) for name, value in convert(*options.raw_files).items()}]
        print(rows[-1], flush=True)
        write(options.table, RAW_COLUMNS, rows)
        return
    table = () if options.table is None else ("--table", options.table)
    for files in options.raw_files:
        words = [sys.executable, __file__, "--raw-files", files, *table]
        subprocess.run(list(map(str, words)), check=True)


def read(table: Path | None) -> list[dict[str, str]]:
    """The rows that are there already."""
    if table is None or not table.exists():
        return []
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def write(table: Path | None, columns: tuple[str, ...], rows: list[dict]) -> None:
    """All rows, in the place of those that were there."""
    if table is not None:
        with replacing_file(table) as aside, aside.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def main() -> None:
    """Does what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--batch-size", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=1e9)
    parser.add_argument("--run", default="pretrained:avoiding")
    parser.add_argument("--raw-files", type=int, nargs="+")
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    (convert_each if options.raw_files else soak)(options)


if __name__ == "__main__":
    main()
