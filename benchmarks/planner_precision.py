# This source code is licensed under the MIT license found in the LICENSE file.
"""Updates per second of the wide MLP planner with matrix products in float32 and in bfloat16, on one core.

    OMP_NUM_THREADS=1 python benchmarks/planner_precision.py [--repeats 10] [--table FILE]

Both are measured in the same run, in turn. A processor without units for bfloat16 emulates it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from planner_speed import median_seconds
from resumable_table import open_table
from tensordict import TensorDict

from torchrl_koap.modules import MLPDenoiser, StatePlanner
from torchrl_koap.objectives import PlannerLoss
from torchrl_koap.runs.device import has_bfloat16_units

TABLE = Path(__file__).parent / "results" / "planner_precision.csv"
COLUMNS = ("processor", "units", "width", "depth", "batch", "float32", "bfloat16", "ratio")
STATE_DIM, HISTORY, HORIZON = 19, 2, 14


def update_of(width: int, depth: int, batch: int, dtype: torch.dtype | None):
    """One training step: loss, gradients, AdamW (fused)."""
    torch.manual_seed(0)
    denoiser = MLPDenoiser(STATE_DIM, HISTORY * STATE_DIM, horizon=HORIZON, width=width, depth=depth)
    planner = StatePlanner(denoiser, state_dim=STATE_DIM, horizon=HORIZON)
    windows = TensorDict({"state": torch.randn(batch, HISTORY + HORIZON, STATE_DIM).cumsum(1)}, [batch])
    planner.fit_normalizers(windows["state"])
    loss = PlannerLoss(planner, dtype=dtype)
    optimizer = torch.optim.AdamW(loss.parameters(), lr=1e-3, fused=True)

    def update() -> None:
        loss(windows)["loss_planner"].backward()
        optimizer.step()
        optimizer.zero_grad()

    return update


def main() -> None:
    """Measures what the table has not of this processor; adds a row per size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    processor = torch.cpu.get_capabilities()["cpu_name"]
    units = has_bfloat16_units()
    done, write = open_table(options.table, COLUMNS, COLUMNS[:5])
    for size in ((512, 4, 512), (512, 4, 256), (256, 3, 128)):
        cell = (processor, int(units), *size)
        if tuple(map(str, cell)) in done:
            continue
        rates = [
            1 / median_seconds(update_of(*size, dtype), options.repeats, time.perf_counter)
            for dtype in (None, torch.bfloat16)
        ]
        row = [*cell, *(f"{rate:.2f}" for rate in rates), f"{rates[1] / rates[0]:.2f}"]
        write(row)
        print(*row)


if __name__ == "__main__":
    main()
