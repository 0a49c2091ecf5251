# This source code is licensed under the MIT license found in the LICENSE file.
"""Kills commands at random moments and compares what they end with, byte by byte, with runs that were left alone.

    python benchmarks/random_kills.py --minutes 20 --table benchmarks/results/random_kills.csv

A command is started as a copy of this process, which has imported everything, ended by a random signal after a random
time, called again until it comes to its end (with ``--resume`` where it has that), and its files are compared with
those of a run that nobody disturbed. Clock times in them are left out. The table has one row per disturbed run.
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
        name (str): what to call it.
        begin (callable): words of the call, given the folder to write.
        again (callable): words of the call that goes on.
        files (tuple of str): patterns of the files that are compared.
        prepare (callable, optional): makes the folder.
    """

    name: str
    begin: Callable[[Path], Sequence[object]]
    again: Callable[[Path], Sequence[object]]
    files: tuple[str, ...]
    prepare: Callable[[Path], None] | None = None


def cases(data: Path, run: Path) -> list[Case]:
    """All commands, on small data."""

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


def call(words: Sequence[object], kill: tuple[str, float] | None = None) -> int:
    """Runs a command in a copy of this process; its exit status, or minus the signal that ended it."""
    child = os.fork()
    if child == 0:
        os.setsid()  # a curve's workers can be told apart from this process
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
                return 0
            time.sleep(0.002)
        os.kill(child, getattr(signal, name))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def content(folder: Path, patterns: Sequence[str]) -> dict[str, object]:
    """What is compared: bytes, and JSON and tables without clock times."""
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
    case: Case, out: Path, alone: dict[str, object], seconds: float, chance: random.Random
) -> dict[str, object]:
    """One run, ended once or several times; the row of it."""
    if case.prepare is not None:
        case.prepare(out)
    signals, times, calls = [], [], 0
    words = case.begin(out)
    for _ in range(chance.choice((1, 1, 2, 3))):
        signals.append(chance.choice(SIGNALS))
        times.append(chance.uniform(0, 1.1 * seconds))
        calls += 1
        if call(words, (signals[-1], times[-1])) == 0:
            break
        words = case.again(out)
    calls += 1
    status = call(case.again(out))
    leftovers = [path.name for path in out.rglob("*") if path.name.endswith((".tmp", ".old"))]
    equal = content(out, case.files) == alone
    return {
        "command": case.name,
        "signals": " ".join(signals),
        "seconds": " ".join(f"{seconds:.3f}" for seconds in times),
        "calls": calls,
        # a recording that was complete when it was ended is refused, and is what was wanted
        "equal": "yes" if equal and (status == 0 or case.name == "demos") else f"no (status {status})",
        "leftovers": len(leftovers),
    }


def main() -> int:
    """Kills for the time asked for, and says how many runs came out equal."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--commands", default="", help="names of commands, with commas between (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    chance, ends, rows = random.Random(options.seed), time.monotonic() + 60 * options.minutes, []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        data, run = write_demonstrations(root / "data"), root / "run"
        assert call(("train", "--out", run, "--dataset", data, *TINY, "--quiet")) == 0
        wanted = [name for name in options.commands.split(",") if name]
        chosen = [case for case in cases(data, run) if not wanted or case.name.split()[0] in wanted]
        alone, took = {}, {}
        number = 0
        while time.monotonic() < ends:
            case = chosen[number % len(chosen)]
            number += 1
            if case.name not in alone:
                left = root / f"alone-{number}"
                if case.prepare is not None:
                    case.prepare(left)
                began = time.monotonic()
                assert call(case.begin(left)) == 0, case.name
                took[case.name] = time.monotonic() - began
                alone[case.name] = content(left, case.files)
                assert alone[case.name], case.name
            out = root / f"killed-{number}"
            rows.append(disturb(case, out, alone[case.name], took[case.name], chance))
            print(" ".join(f"{rows[-1][name]}" for name in COLUMNS), flush=True)
            shutil.rmtree(out, ignore_errors=True)
            if options.table is not None:
                write_table(options.table, rows)
    equal = sum(row["equal"] == "yes" for row in rows)
    kills = sum(len(row["signals"].split()) for row in rows)
    print(f"{len(rows)} runs ended {kills} times: {equal} equal to a run that was left alone")
    return 0 if equal == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
