# This source code is licensed under the MIT license found in the LICENSE file.
"""Kills commands at random times and compares their files byte by byte with those of undisturbed runs.

    python benchmarks/random_kills.py --minutes 20 --table benchmarks/results/random_kills.csv

A command is started as a fork of this process, which has imported everything. A random signal ends it after a random
time. It is called again until it finishes, with ``--resume`` if it has that option. Clock times in the files are not
compared. The table has one row per disturbed run.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

import torch  # noqa: E402
from tables import write_table  # noqa: E402
from tiny_runs import TINY, write_demonstrations  # noqa: E402

import torchrl_koap.envs.registry  # noqa: E402, F401
from torchrl_koap.commands import subcommands  # noqa: E402, F401
from torchrl_koap.commands.cli import main as koap  # noqa: E402

SIGNALS = ("SIGKILL", "SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")
COLUMNS = ("command", "signals", "seconds", "calls", "equal", "leftovers")
CLOCK = ("train_seconds", "eval_seconds", "iterations_per_second", "plan_ms", "control_ms", "control_hz")
OUTSIDE = (*CLOCK, "out", "command", "resume")  # entries that are not compared


@dataclass(frozen=True)
class Case:
    """A command that is disturbed.

    Args:
        name (str): name in the table.
        begin (callable): from the folder to write to the words of the first call.
        again (callable): from that folder to the words of the call that resumes.
        files (tuple of str): patterns of the files to compare.
        prepare (callable, optional): creates the folder.
    """

    name: str
    begin: Callable[[Path], Sequence[object]]
    again: Callable[[Path], Sequence[object]]
    files: tuple[str, ...]
    prepare: Callable[[Path], None] | None = None


def cases(data: Path, run: Path) -> list[Case]:
    """Returns all commands, on small data."""

    def train(method: str) -> Case:
        words = ("--dataset", data, *TINY, "--steps", 60, "--controller.steps", 60)
        return Case(
            f"train {method}",
            lambda out: ("train", "--out", out, "--method", method, *words, "--quiet"),
            lambda out: (
                ("train", "--out", out, "--resume", *(words if not (out / "config.json").exists() else ()))
                + (() if (out / "config.json").exists() else ("--method", method))
                + ("--quiet",)
            ),
            ("*.safetensors", "metrics.csv", "summary.json"),
        )

    def evaluated(out: Path) -> tuple[object, ...]:
        return ("eval", out, "--episodes", 3, "--threads", 1, "--no-report", "--quiet")

    def recorded(out: Path) -> tuple[object, ...]:
        return ("demos", "--out", out, "--episodes", 3, "--threads", 1, "--quiet")

    def curve(out: Path) -> tuple[object, ...]:
        words = ("--methods", "linear", "koap", "--labels", 0.25, "--seeds", 1, "--planner.steps", 20)
        words += ("--evaluation.episodes", 1)
        return ("curve", "--out", out, "--datasets", data, *words, "--workers", 1, "--quiet")

    return [
        *(train(method) for method in ("koap", "linear", "dp", "dd", "koap_sgd", "vae", "relabel")),
        Case(
            "eval",
            evaluated,
            evaluated,
            ("rollouts.safetensors", "eval.json", "planner.safetensors", "config.json"),
            lambda out: shutil.copytree(run, out),
        ),
        Case("demos", recorded, recorded, ("ted/**/*", "raw/*")),
        Case("curve", curve, curve, ("cells/*/*/*.safetensors", "planners/*/*/*.safetensors", "cells.csv")),
    ]


def call(words: Sequence[object], kill: tuple[str, float] | None = None) -> int | None:
    """Runs a command in a fork of this process, which a signal may ``kill`` after some seconds.

    Returns its exit status, or minus the signal that ended it; None if it ended before the signal was sent.
    """
    child = os.fork()
    if child == 0:
        os.setsid()  # separates a curve's workers from this process
        for number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        status = 1
        try:
            status = koap([str(word) for word in words])
        except SystemExit as left:
            status = left.code
        finally:
            os._exit(status)
    if kill is not None:
        name, seconds = kill
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            if os.waitpid(child, os.WNOHANG)[0]:
                return None
            time.sleep(0.002)
        os.kill(child, getattr(signal, name))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def content(folder: Path, patterns: Sequence[str]) -> dict[str, object]:
    """Reads the files to compare: bytes, and JSON and tables without clock times."""
    found: dict[str, object] = {}
    for path in sorted({path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}):
        name = str(path.relative_to(folder))
        if path.suffix == ".json":
            found[name] = _timeless(json.loads(path.read_text()))
        elif path.suffix == ".csv":
            with path.open(newline="") as file:
                found[name] = [_timeless(row) for row in csv.DictReader(file)]
        else:
            found[name] = path.read_bytes()
    return found


def _timeless(value):
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if key not in OUTSIDE}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value


def disturb(
    case: Case, out: Path, undisturbed: dict[str, object], seconds: float, generator: random.Random
) -> dict[str, object]:
    """Runs a command, to which up to three signals are sent; returns its row, whose signals may be empty."""
    if case.prepare is not None:
        case.prepare(out)
    signals, times, calls = [], [], 0
    words = case.begin(out)
    for _ in range(generator.choice((1, 1, 2, 3))):
        name, wait = generator.choice(SIGNALS), generator.uniform(0, 1.1 * seconds)
        calls += 1
        if call(words, (name, wait)) is None:
            break
        signals.append(name)
        times.append(wait)
        words = case.again(out)
    calls += 1
    status = call(case.again(out))
    leftovers = [path.name for path in out.rglob("*") if path.name.endswith((".tmp", ".old"))]
    equal = content(out, case.files) == undisturbed
    return {
        "command": case.name,
        "signals": " ".join(signals),
        "seconds": " ".join(f"{seconds:.3f}" for seconds in times),
        "calls": calls,
        # `koap demos` refuses to record again when the killed call had already finished: any status is accepted
        "equal": "yes" if equal and (status == 0 or case.name == "demos") else f"no (status {status})",
        "leftovers": len(leftovers),
    }


def main() -> int:
    """Disturbs runs for the given time and prints how many ended with equal files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--commands", default="", help="names of commands, with commas between (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator, ends, rows = random.Random(options.seed), time.monotonic() + 60 * options.minutes, []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        data, run = write_demonstrations(root / "data"), root / "run"
        assert call(("train", "--out", run, "--dataset", data, *TINY, "--quiet")) == 0
        wanted = [name for name in options.commands.split(",") if name]
        chosen = [case for case in cases(data, run) if not wanted or case.name.split()[0] in wanted]
        undisturbed, took = {}, {}
        number = 0
        while time.monotonic() < ends:
            case = chosen[number % len(chosen)]
            number += 1
            if case.name not in undisturbed:
                reference = root / f"undisturbed-{number}"
                if case.prepare is not None:
                    case.prepare(reference)
                began = time.monotonic()
                assert call(case.begin(reference)) == 0, case.name
                took[case.name] = time.monotonic() - began
                undisturbed[case.name] = content(reference, case.files)
                assert undisturbed[case.name], case.name
            out = root / f"killed-{number}"
            row = disturb(case, out, undisturbed[case.name], took[case.name], generator)
            print(" ".join(f"{row[name]}" for name in COLUMNS), flush=True)
            rows += [row] if row["signals"] else []
            shutil.rmtree(out, ignore_errors=True)
            if options.table is not None and rows:
                write_table(options.table, rows)
    equal = sum(row["equal"] == "yes" for row in rows)
    kills = sum(len(row["signals"].split()) for row in rows)
    print(f"{len(rows)} runs ended {kills} times: {equal} equal to an undisturbed run")
    return 0 if equal == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
