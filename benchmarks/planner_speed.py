# This source code is licensed under the MIT license found in the LICENSE file.
"""Training speed and plan latency on one core, beside the architecture of KOAP's first public code.

    python benchmarks/planner_speed.py [--repeats 10] [--threads 1] [--wall] [--json FILE]

Both planners are measured in the same run, in CPU time: with one thread that equals wall time on an idle machine, and
it is what can be compared on a shared one (``--wall`` for the other clock). Anchors (first public code,
one core): 1.19 it/s at batch 256; 309 ms for one plan, 3300 ms for 60 plans, each with 50 DDPM steps.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.unet import TemporalUnet
from torchrl_koap.objectives import PlannerLoss

ANCHORS = {"train_it_s": 1.19, "plan_1_ms": 309.0, "plan_60_ms": 3300.0}


def default_planner(num_steps: int) -> StatePlanner:
    """The library's planner for Avoiding: 2 state columns, 14 planned frames."""
    return StatePlanner(TemporalUnet(2, 4), state_dim=2, num_steps=num_steps, clip=1.2)


def median_seconds(call: Callable[[], object], repeats: int, clock: Callable[[], float], warm_up: int = 2) -> float:
    """Median time of a call."""
    times = []
    for index in range(warm_up + repeats):
        start = clock()
        call()
        if index >= warm_up:
            times.append(clock() - start)
    return sorted(times)[len(times) // 2]


def measure(planner: StatePlanner, repeats: int, clock: Callable[[], float]) -> dict[str, float]:
    """One training step is loss, gradients, AdamW (fused) and the average of the weights, at batch 256."""
    length = planner.history + planner.horizon
    windows = TensorDict({"state": torch.randn(256, length, planner.state_dim).cumsum(1)}, [256])
    planner.fit_normalizers(windows["state"])
    loss = PlannerLoss(planner)
    average = SoftUpdate(loss, eps=0.995)
    optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3, fused=True)

    def train() -> None:
        loss(windows)["loss_planner"].backward()
        optimizer.step()
        optimizer.zero_grad()
        average.step()

    result = {"train_it_s": 1 / median_seconds(train, repeats, clock)}
    with torch.no_grad():
        for batch in (1, 60):
            history = windows["state"][:batch, : planner.history]
            result[f"plan_{batch}_ms"] = 1e3 * median_seconds(
                lambda history=history: planner.sample(history), repeats, clock
            )
    result["parameters"] = sum(parameter.numel() for parameter in planner.denoiser.parameters())
    return result


def main() -> None:
    """Measures and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--wall", action="store_true", help="wall-clock time instead of CPU time")
    parser.add_argument("--json", type=Path, default=None, help="file to write the numbers to")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)

    clock = time.perf_counter if options.wall or options.threads > 1 else time.process_time
    rows = {
        "default (10 DPM-Solver++ steps)": measure(default_planner(10), 4 * options.repeats, clock),
        "default (5 DPM-Solver++ steps)": measure(default_planner(5), 4 * options.repeats, clock),
    }
    lines = [f"{'':34}{'parameters':>12}{'train it/s':>14}{'plan 1, ms':>14}{'plan 60, ms':>14}"]
    lines.append(
        f"{'anchor (first public code)':34}{11_881_220:>12}" + "".join(f"{v:>14.2f}" for v in ANCHORS.values())
    )
    for name, row in rows.items():
        lines.append(f"{name:34}{row['parameters']:>12}" + "".join(f"{row[key]:>14.2f}" for key in ANCHORS))
        ratios = [row["train_it_s"] / ANCHORS["train_it_s"]]
        ratios += [ANCHORS[key] / row[key] for key in ("plan_1_ms", "plan_60_ms")]
        lines.append(f"{'    x anchor':46}" + "".join(f"{ratio:>13.1f}x" for ratio in ratios))
    sys.stdout.write("\n".join(lines) + "\n")
    if options.json is not None:
        options.json.write_text(json.dumps({"anchors": ANCHORS, "threads": options.threads, **rows}, indent=2))


if __name__ == "__main__":
    main()
