# This source code is licensed under the MIT license found in the LICENSE file.
"""Times a whole policy on one core: exported in several ways, and in a control loop with a 100 ms planner.

    python benchmarks/latency.py --write            # a policy of the default size, random weights
    python benchmarks/latency.py --run runs/demo    # a trained one
    python benchmarks/latency.py --loop-steps 800   # plans between control steps, and in a thread

Each export is first compared with the eager policy. All are then called in turn, so that a busy machine slows them
alike. ``--write`` writes ``benchmarks/results/exported_policy.csv``. torch.compile needs a C++ compiler, ONNX the
extra ``onnx``; an export that cannot be made is skipped with a message.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
import tyro
from tables import write_table
from torch import Tensor

from torchrl_koap import Trained, load_policy
from torchrl_koap.evaluation.latency import run_control_loop
from torchrl_koap.modules import (
    Agent,
    AsynchronousAgent,
    PlanningPolicy,
    StatePlanner,
    TemporalUnet,
    make_koopman_inverse_dynamics,
    make_policy,
)
from torchrl_koap.modules.execution.export import (
    SUFFIXES,
    Exportable,
    ExportError,
    export_policy,
    exportable,
    relative_gap,
)
from torchrl_koap.modules.windows import StateReader

RESULTS = Path(__file__).resolve().parent / "results" / "exported_policy.csv"
TOLERANCE = 1e-5


class SlowPlanner(StatePlanner):
    """Delays every plan to the time of a large planner on a small computer."""

    seconds = 0.1

    def solve(self, *arguments, **options):
        """Plans, then waits until ``seconds`` have passed."""
        began = time.perf_counter()
        plan = super().solve(*arguments, **options)
        time.sleep(max(self.seconds - (time.perf_counter() - began), 0))
        return plan


def default_policy() -> tuple[PlanningPolicy, int]:
    """Returns a policy for seven joints and their goals in the default size, and the width of its observation."""
    planner = StatePlanner(TemporalUnet(14, 28, channels=(64, 128)), state_dim=14)
    controller = make_koopman_inverse_dynamics(7, 7)
    return make_policy(planner, controller, state_of=range(14), reads=StateReader(range(7))), 14


def compiled(target: Exportable) -> Callable:
    """Compiles the policy with torch.compile and compares it with the eager one."""
    try:
        function = torch.compile(target.module, fullgraph=True, dynamic=False)
        gap = relative_gap(function(*target.inputs.values()), target.module(*target.inputs.values()))
    except Exception as error:  # a missing compiler raises various errors
        raise ExportError(f"torch.compile needs a C++ compiler such as g++: {str(error).splitlines()[0]}") from error
    if not gap <= TOLERANCE:
        raise ExportError(f"torch.compile differs from the policy by {gap:.1e}, at most {TOLERANCE:.0e} is allowed")
    return function


def time_calls(
    functions: Mapping[str, Callable[..., Tensor]], inputs: tuple[Tensor, ...], *, repeats: int = 100
) -> dict[str, dict[str, float]]:
    """Times functions that are called in turn, so that a busy machine slows them alike.

    Ten warm-up calls of each are not counted. Returns by name ``p50`` and ``p99`` in ms, and ``ratio``, the median of
    the time divided by that of the first function in the same turn.
    """
    taken: dict[str, list[float]] = {name: [] for name in functions}
    with torch.no_grad():
        for turn in range(repeats + 10):
            for name, function in functions.items():
                began = time.perf_counter()
                function(*inputs)
                if turn >= 10:
                    taken[name].append(1e3 * (time.perf_counter() - began))
    first = np.array(next(iter(taken.values())))
    return {
        name: {
            "p50": float(np.percentile(times, 50)),
            "p99": float(np.percentile(times, 99)),
            "ratio": float(np.median(np.array(times) / first)),
        }
        for name, times in taken.items()
    }


def exported(run: Path | None, repeats: int) -> list[dict[str, str]]:
    """Returns a row per way to call a policy."""
    policy, width = default_policy() if run is None else (load_policy(run), Trained.load(run).task.observation_dim)
    target = exportable(policy, columns={"observations": {f"column {index}": "" for index in range(width)}})
    ways: dict[str, Callable] = {"eager": target.module}
    seconds = {"eager": 0.0}
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        for way in ("compile", *SUFFIXES):
            began = time.perf_counter()
            try:
                if way == "compile":
                    ways[way] = compiled(target)
                else:
                    file = Path(folder) / f"policy{SUFFIXES[way]}"
                    ways[way] = export_policy(target, file, kind=way, tolerance=TOLERANCE)
            except ExportError as error:
                print(f"{way}: {error}")
            seconds[way] = time.perf_counter() - began
        times = time_calls(ways, tuple(target.inputs.values()), repeats=repeats)
    rows = [{"way": way, "p50_ms": f"{row['p50']:.2f}", "p99_ms": f"{row['p99']:.2f}"} for way, row in times.items()]
    more = [
        {"over_eager": f"{times[row['way']]['ratio']:.2f}", "preparation_s": f"{seconds[row['way']]:.0f}"}
        for row in rows
    ]
    return [row | other for row, other in zip(rows, more, strict=True)]


def print_loops(steps: int, control_hz: float) -> None:
    """Prints the late steps of a control loop that plans between its steps, and of one that plans in a thread."""
    planner = SlowPlanner(TemporalUnet(7, 14, channels=(16, 32)), state_dim=7, num_steps=4)
    policy = make_policy(planner, make_koopman_inverse_dynamics(7, 7), state_of=range(7))
    observations = np.random.default_rng(0).normal(size=(steps, 7)).cumsum(0) / 100
    print("between steps", run_control_loop(Agent(policy), observations, control_hz=control_hz))
    with AsynchronousAgent(policy, control_hz=control_hz) as agent:
        print("in a thread  ", run_control_loop(agent, observations, control_hz=control_hz))


def main(
    *, run: Path | None = None, repeats: int = 200, write: bool = False, loop_steps: int = 0, control_hz: float = 30.0
) -> None:
    """Prints the table of exported policies, or the control loops.

    Args:
        run: run directory. Default: random weights.
        repeats: timed calls per way.
        write: write the table.
        loop_steps: measure control loops of this many steps instead of the table.
        control_hz: rate of the control loops.
    """
    torch.set_num_threads(1)
    torch.manual_seed(0)
    if loop_steps:
        print_loops(loop_steps, control_hz)
        return
    rows = exported(run, repeats)
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    if write:
        write_table(RESULTS, rows)


if __name__ == "__main__":
    tyro.cli(main)
