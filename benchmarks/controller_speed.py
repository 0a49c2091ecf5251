# This source code is licensed under the MIT license found in the LICENSE file.
"""Training updates per second of the inverse dynamics, batch 256 windows x 16 frames, one core.

    OMP_NUM_THREADS=1 python benchmarks/controller_speed.py

All presets in one run; the ratio is against the released architecture in our modules. The first public code made 3.35
updates per second on one core of such a machine (issue 2).
"""

from __future__ import annotations

import argparse
import time

import torch

from torchrl_koap.data import Normalizer, flatten_trajectories, make_window_buffer, select_state
from torchrl_koap.modules import PRESETS, make_koopman_inverse_dynamics
from torchrl_koap.objectives import KOAPLoss

ANCHOR = 3.35


def updates_per_second(preset: str, seconds: float, clock) -> tuple[float, int]:
    """Updates per second, optimiser and sampling included, and the number of parameters."""
    torch.manual_seed(0)
    paths = [torch.randn(81, 4).cumsum(0) * 0.01 for _ in range(96)]
    data = select_state(flatten_trajectories(paths, [path[1:, :2] - path[:-1, :2] for path in paths]), (2, 3))
    model = make_koopman_inverse_dynamics(
        2,
        2,
        preset=preset,
        state_normalizer=Normalizer.fit(data["state"]),
        action_normalizer=Normalizer.fit(data["action"]),
    )
    loss = KOAPLoss(model)
    buffer = make_window_buffer(data, 16, 256, select=["state", "action", "has_action"], labelled_share=0.25)
    optimizer = torch.optim.AdamW(loss.parameters(), 3e-4, fused=True)

    def update() -> None:
        losses = loss(buffer.sample())
        sum(losses.values()).backward()
        optimizer.step()
        optimizer.zero_grad()

    for _ in range(2):
        update()
    updates, began = 0, clock()
    while clock() - began < seconds:
        update()
        updates += 1
    return updates / (clock() - began), sum(p.numel() for p in model.parameters())


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="per preset")
    parser.add_argument("--cpu-time", action="store_true", help="count CPU seconds: for a machine that is busy")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    measured = {preset: updates_per_second(preset, arguments.seconds, clock) for preset in PRESETS}
    print(f"{'preset':<10}{'parameters':>12}{'it/s':>8}{'x released here':>17}{'x anchor (' + str(ANCHOR) + ')':>17}")
    for preset, (rate, parameters) in measured.items():
        print(f"{preset:<10}{parameters:>12,}{rate:>8.2f}{rate / measured['released'][0]:>17.1f}{rate / ANCHOR:>17.1f}")


if __name__ == "__main__":
    main()
