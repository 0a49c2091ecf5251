# This source code is licensed under the MIT license found in the LICENSE file.
"""Seconds to choose a ridge's penalty by trajectories left out: systems of their rows against what the library solves.

    OMP_NUM_THREADS=1 python benchmarks/left_out_groups.py [--table FILE]

Both give the same errors (asserted). The first solves, for every penalty and trajectory, the system of all its rows,
as the library did; the other takes the directions of the features where they are fewer, and the symmetry.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from resumable_table import open_table
from torch import Tensor

from torchrl_koap.modules.koopman.held_out_errors import held_out_errors

TABLE = Path(__file__).parent / "results" / "left_out_groups.csv"
COLUMNS = ("trajectories", "rows", "directions", "penalties", "row_systems_s", "library_s", "ratio")
PENALTIES = 9
# labelled windows of Stacking at the first and the last level, ridges of components and of Fourier features
SIZES = ((600, 6, 544), (600, 570, 64), (600, 570, 544))


def row_systems(left: Tensor, shrinks: Tensor, target: Tensor, groups: Tensor) -> Tensor:
    """The errors by one system of all rows of a trajectory for every penalty."""
    projected, errors = left.mT @ target, []
    for shrink in shrinks:
        residual = target - left @ (shrink[:, None] * projected)
        total = torch.zeros_like(target[0])
        for group in range(int(groups.max()) + 1):
            rows = groups == group
            hat = (left[rows] * shrink) @ left[rows].mT
            total += torch.linalg.solve(torch.eye(len(hat)).to(hat) - hat, residual[rows]).square().sum(0)
        errors.append(total / len(left))
    return torch.stack(errors)


def main() -> None:
    """Measures the sizes that the table has not; adds a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    torch.set_num_threads(1)
    done, write = open_table(options.table, COLUMNS, COLUMNS[:4])
    for trajectories, rows, directions in SIZES:
        if tuple(map(str, (trajectories, rows, directions, PENALTIES))) in done:
            continue
        torch.manual_seed(0)
        groups = torch.arange(trajectories).repeat_interleave(rows)
        left = torch.randn(len(groups), directions, dtype=torch.float64) / len(groups) ** 0.5
        target = torch.randn(len(groups), 7, dtype=torch.float64)
        shrinks = torch.linspace(0.1, 0.9, PENALTIES, dtype=torch.float64)[:, None].expand(-1, directions)
        seconds, errors = [], []
        for solve in (row_systems, lambda *rows: held_out_errors(*rows, centred=False)):
            began = time.perf_counter()
            errors.append(solve(left, shrinks, target, groups))
            seconds.append(time.perf_counter() - began)
        torch.testing.assert_close(*errors)
        ratio = f"{seconds[0] / seconds[1]:.1f}"
        row = [trajectories, rows, directions, PENALTIES, *(f"{s:.2f}" for s in seconds), ratio]
        write(row)
        print(*row)


if __name__ == "__main__":
    main()
