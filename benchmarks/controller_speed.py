# This source code is licensed under the MIT license found in the LICENSE file.
"""Training updates per second of the inverse dynamics, batch 256 windows x 16 frames, one core.

    OMP_NUM_THREADS=1 python benchmarks/controller_speed.py

All presets in one run; the ratio is against the networks of the first public code (first_code.py). "default, widened"
is our default with as many parameters as those, so that the ratio is not one of sizes. The first public code made 3.35
updates per second on one core of such a machine. ``--profile`` prints where the time of a preset goes.
"""

from __future__ import annotations

import argparse
import time

import first_code
import torch

from torchrl_koap.data import flatten_trajectories, make_window_buffer, select_state
from torchrl_koap.modules import PRESETS, Normalizer, make_koopman_inverse_dynamics
from torchrl_koap.objectives import KOAPLoss

ANCHOR = 3.35
FIRST = "first code"


def make_model(preset: str, **options):
    """A model for states and actions of Avoiding: of a preset, or that of the first public code."""
    if preset == FIRST:
        return first_code.build(2, 2, options, {})
    return make_koopman_inverse_dynamics(2, 2, preset=preset, **options)


def size_of(preset: str, **overrides) -> int:
    """Number of parameters."""
    return sum(p.numel() for p in make_model(preset, **overrides).parameters())


def width_of_equal_size() -> int:
    """Hidden width of the lifting with which the default has as many parameters as the first public code's networks."""
    wanted = size_of(FIRST)
    return min(range(64, 1025, 8), key=lambda width: abs(size_of("default", hidden_dim=width) - wanted))


def make_update(preset: str, **overrides):
    """One update, optimiser and sampling included, as a function; and the number of parameters."""
    torch.manual_seed(0)
    paths = [torch.randn(81, 4).cumsum(0) * 0.01 for _ in range(96)]
    data = select_state(flatten_trajectories(paths, [path[1:, :2] - path[:-1, :2] for path in paths]), (2, 3))
    model = make_model(
        preset,
        state_normalizer=Normalizer.fit(data["state"]),
        action_normalizer=Normalizer.fit(data["action"]),
        **overrides,
    )
    loss = KOAPLoss(model)
    buffer = make_window_buffer(
        data, max(16, model.num_window_frames), 256, select=["state", "action", "has_action"], labelled_share=0.25
    )
    optimizer = torch.optim.AdamW(loss.parameters(), 3e-4, fused=True)

    def update() -> None:
        losses = loss(buffer.sample())
        sum(losses.values()).backward()
        optimizer.step()
        optimizer.zero_grad()

    return update, sum(p.numel() for p in model.parameters())


def updates_per_second(preset: str, seconds: float, clock, **overrides) -> tuple[float, int]:
    """Updates per second and the number of parameters."""
    update, parameters = make_update(preset, **overrides)
    for _ in range(2):
        update()
    updates, began = 0, clock()
    while clock() - began < seconds:
        update()
        updates += 1
    return updates / (clock() - began), parameters


def print_profile(preset: str, updates: int = 20) -> None:
    """Where the CPU time of an update goes, operator by operator."""
    update, _ = make_update(preset)
    update()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        for _ in range(updates):
            update()
    print(f"{preset}, {updates} updates")
    print(profile.key_averages().table(sort_by="self_cpu_time_total", row_limit=12, max_name_column_width=40))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="per preset")
    parser.add_argument("--cpu-time", action="store_true", help="count CPU seconds: for a machine that is busy")
    parser.add_argument("--profile", action="store_true", help="print the time per operator instead")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    if arguments.profile:
        for preset in ("default", FIRST):
            print_profile(preset)
        return
    measured = {preset: updates_per_second(preset, arguments.seconds, clock) for preset in (*PRESETS, FIRST)}
    wide = width_of_equal_size()
    measured["default, widened"] = updates_per_second("default", arguments.seconds, clock, hidden_dim=wide)
    print(f"{'preset':<18}{'parameters':>12}{'it/s':>8}{'x first code here':>19}{'x anchor (' + str(ANCHOR) + ')':>17}")
    for preset, (rate, parameters) in measured.items():
        print(f"{preset:<18}{parameters:>12,}{rate:>8.2f}{rate / measured[FIRST][0]:>19.1f}{rate / ANCHOR:>17.1f}")


if __name__ == "__main__":
    main()
