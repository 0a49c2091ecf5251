# This source code is licensed under the MIT license found in the LICENSE file.
"""Time of a whole policy, one plan and its actions at batch one on one core: eager, compiled and exported.

    python benchmarks/exported_policy.py --write         # a policy of the default size, random weights
    python benchmarks/exported_policy.py --run runs/demo  # a trained one

Every way is called in turn, so that a busy machine slows all of them alike; before that its actions are compared with
the eager ones. ``--write`` writes ``benchmarks/results/exported_policy.csv``. torch.compile and AOTInductor need a C++
compiler, ONNX the extra ``onnx``; what is missing is named and left out.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchrl_koap.evaluation import load_policy
from torchrl_koap.evaluation.latency import time_calls
from torchrl_koap.modules import PlanningPolicy, StatePlanner, TemporalUnet, make_koopman_inverse_dynamics, make_policy
from torchrl_koap.modules.execution.export import SUFFIXES, Exportable, ExportError, export_part, exportable

RESULTS = Path(__file__).resolve().parent / "results" / "exported_policy.csv"
TOLERANCE = 1e-5


def default_policy() -> tuple[PlanningPolicy, int]:
    """A policy for seven joints and their goals, of the size that ``koap train`` gives it, and its observation."""
    torch.manual_seed(0)
    planner = StatePlanner(TemporalUnet(14, 28, channels=(64, 128)), state_dim=14, forecast=True, clip=1.2)
    controller = make_koopman_inverse_dynamics(7, 7)
    return make_policy(planner, controller, state_of=range(14), columns=range(7)), 14


def compiled(what: Exportable, expected: Tensor) -> Callable:
    """The policy through torch.compile, compared with the eager one."""
    try:
        function = torch.compile(what.module, fullgraph=True, dynamic=False)
        found = function(*what.inputs.values())
    except Exception as error:  # the compiler is asked in many places
        raise ExportError(f"torch.compile needs a C++ compiler such as g++: {str(error).splitlines()[0]}") from error
    gap = float((found - expected).abs().max() / expected.abs().max().clamp_min(1))
    if not gap <= TOLERANCE:
        raise ExportError(f"torch.compile differs from the policy by {gap:.1e}, at most {TOLERANCE:.0e} is allowed")
    return function


def main() -> None:
    """Prints the table and, if asked, writes it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="run directory instead of random weights")
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--ways", nargs="+", default=["compile", *SUFFIXES], help="of compile, torch, onnx, aoti")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.run is None:
        policy, width = default_policy()
    else:
        policy = load_policy(options.run)
        width = policy.description.task.observation_dim
    what = exportable(policy, observation_dim=width)
    ways: dict[str, Callable] = {"eager": what.module}
    seconds = {"eager": 0.0}
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        expected = what.module(*what.inputs.values())
        for way in options.ways:
            began = time.perf_counter()
            try:
                if way == "compile":
                    ways[way] = compiled(what, expected)
                else:
                    file = Path(folder) / f"policy{SUFFIXES[way]}"
                    ways[way] = export_part(what, file, kind=way, tolerance=TOLERANCE)
            except ExportError as error:
                print(f"{way}: {error}")
            seconds[way] = time.perf_counter() - began
        times = time_calls(ways, tuple(what.inputs.values()), repeats=options.repeats)
    rows = [{"way": way, "p50_ms": f"{row['p50']:.2f}", "p99_ms": f"{row['p99']:.2f}"} for way, row in times.items()]
    for row in rows:
        row |= {"over_eager": f"{times[row['way']]['ratio']:.2f}", "preparation_s": f"{seconds[row['way']]:.0f}"}
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    if options.write:
        with RESULTS.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
