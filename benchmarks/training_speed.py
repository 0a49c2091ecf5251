# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures the speed of training and planning on one core; writes tables in ``benchmarks/results``.

    OMP_NUM_THREADS=1 python benchmarks/training_speed.py --part controller planner
    OMP_NUM_THREADS=1 python benchmarks/training_speed.py --part precision
    OMP_NUM_THREADS=1 python benchmarks/training_speed.py --part loop
    python benchmarks/training_speed.py --part cuda

controller: every preset of KOAP, batches of 256 windows of 16 frames (17 for "semi_supervised"), sampling included.
planner: updates of the default U-Net with 256 windows, and batches of 1 and 60 plans. precision: updates of wide MLPs
with matrix products in float32 and bfloat16, which some processors emulate. loop: the training loop compared with bare
updates of the same network, eager and compiled. cuda: the training loop on a GPU, windows and augmentation included:
eager, with a compiled denoiser, and with updates replayed as a CUDA graph.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal

import torch
import tyro
from tables import open_table
from tensordict import TensorDict
from torchrl.objectives import LossModule

from torchrl_koap.data import (
    RecoveryAugmentation,
    cut_windows,
    flatten_trajectories,
    make_window_buffer,
    select_state,
)
from torchrl_koap.modules import (
    PRESETS,
    MLPDenoiser,
    Normalizer,
    StatePlanner,
    TemporalUnet,
    make_koopman_inverse_dynamics,
)
from torchrl_koap.objectives import KOAPLoss, PlannerLoss
from torchrl_koap.runs.device import has_bfloat16_units
from torchrl_koap.training.loop import moving_average, train_phase

RESULTS = Path(__file__).parent / "results"
SPEED = ("part", "variant", "parameters", "updates_per_second", "plan_1_ms", "plan_60_ms", "command")
PRECISION = ("processor", "units", "width", "depth", "batch", "float32", "bfloat16", "ratio")
COMMAND = "OMP_NUM_THREADS=1 python benchmarks/training_speed.py --part controller planner"
CUDA = ("device", "network", "batch", "precision", "eager", "compiled", "replayed", "one_core", "beside")
LOOP = ("processor", "units", "network", "batch", "loop_ms", "bare_ms", "compiled_ms", "over_bare", "over_compiled")
BATCH, UPDATES = 512, 600
SIZES = ((512, 4, 512), (512, 4, 256), (256, 3, 128))  # width, residual layers, batch


def median_seconds(call: Callable[[], object], repeats: int, warm_up: int = 2) -> float:
    """Returns the median time of a call in seconds."""
    times = []
    for index in range(warm_up + repeats):
        began = time.perf_counter()
        call()
        if index >= warm_up:
            times.append(time.perf_counter() - began)
    return sorted(times)[len(times) // 2]


def update_of(loss: LossModule, batches: Callable[[], TensorDict]) -> Callable[[], None]:
    """Returns a function that makes one update: loss, gradients, AdamW (fused)."""
    optimizer = torch.optim.AdamW(loss.parameters(), lr=3e-4, fused=True)

    def update() -> None:
        losses = loss(batches())
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()

    return update


def size_of(module: torch.nn.Module) -> int:
    """Returns the number of parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def controllers(repeats: int) -> Iterable[tuple[object, ...]]:
    """Yields a row per preset of KOAP, for states and actions of Avoiding."""
    torch.manual_seed(0)
    paths = [torch.randn(81, 4).cumsum(0) * 0.01 for _ in range(96)]
    data = select_state(flatten_trajectories(paths, [path[1:, :2] - path[:-1, :2] for path in paths]), (2, 3))
    normalizers = {f"{name}_normalizer": Normalizer.fit(data[name]) for name in ("state", "action")}
    for preset in PRESETS:
        model = make_koopman_inverse_dynamics(2, 2, preset=preset, **normalizers)
        entries, frames = ["state", "action", "has_action"], max(16, model.num_window_frames)
        buffer = make_window_buffer(data, frames, 256, select=entries, labelled_share=0.25)
        seconds = median_seconds(update_of(KOAPLoss(model), buffer.sample), repeats)
        yield "controller", preset, size_of(model), f"{1 / seconds:.2f}", "", "", COMMAND


def planners(repeats: int) -> Iterable[tuple[object, ...]]:
    """Yields a row for the default planner of Avoiding."""
    torch.manual_seed(0)
    planner = StatePlanner(TemporalUnet(2, 4), state_dim=2, num_steps=10)
    windows = TensorDict({"state": torch.randn(256, planner.history + planner.horizon, 2).cumsum(1)}, [256])
    planner.fit_normalizers(windows["state"])
    updates = 1 / median_seconds(update_of(PlannerLoss(planner), lambda: windows), repeats)
    plans = []
    for batch in (1, 60):
        history = windows["state"][:batch, : planner.history]
        with torch.no_grad():
            seconds = median_seconds(lambda history=history: planner.sample(history), repeats)
        plans.append(f"{1e3 * seconds:.2f}")
    yield "planner", "default (10 DPM-Solver++ steps)", size_of(planner.denoiser), f"{updates:.2f}", *plans, COMMAND


def wide_update(width: int, depth: int, batch: int, dtype: torch.dtype | None) -> Callable[[], None]:
    """Returns an update of a wide MLP planner for 19 columns with matrix products in ``dtype``."""
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(19, 38, horizon=14, width=width, depth=depth), state_dim=19, horizon=14)
    windows = TensorDict({"state": torch.randn(batch, 16, 19).cumsum(1)}, [batch])
    planner.fit_normalizers(windows["state"])
    return update_of(PlannerLoss(planner, dtype=dtype), lambda: windows)


def make_denoiser(network: str) -> torch.nn.Module:
    """Returns a planner's network for 19 columns."""
    return MLPDenoiser(19, 38, horizon=14) if network == "mlp" else TemporalUnet(19, 38)


def loop_rate(network: str, *, device: str, replay: bool = False, compiled: bool = False) -> float:
    """Returns updates per second of the training loop in bfloat16 for 19 columns, without the first 100."""
    torch.manual_seed(0)
    denoiser = make_denoiser(network)
    planner = StatePlanner(denoiser, state_dim=19)
    paths = [torch.randn(200, 19).cumsum(0) * 0.01 for _ in range(100)]
    data = select_state(flatten_trajectories(paths, None, action_dim=1), range(19)).to(device)
    planner.fit_normalizers(cut_windows(data, 16, select=["state"])["state"])
    planner.to(device)
    if compiled:
        planner.denoiser.compile()
    loss = PlannerLoss(planner, dtype=torch.bfloat16)
    buffer, augment = make_window_buffer(data, 16, BATCH, select=["state"]), RecoveryAugmentation(0.01)
    times: list[float] = []
    train_phase(
        "planner",
        loss,
        lambda: augment(buffer.sample()),
        num_steps=UPDATES,
        learning_rate=1e-3,
        target_update=moving_average(loss, UPDATES),
        replay=replay,
        log_every=100,  # reading the losses waits for the GPU
        progress=lambda done, values: times.append(time.perf_counter()) if done % 100 == 0 else None,
    )
    return (UPDATES - 100) / (times[-1] - times[0])


def bare_update(network: str, *, compiled: bool) -> Callable[[], None]:
    """Returns a minimal update of the network of :func:`loop_rate`: noise, squared error, AdamW."""
    torch.manual_seed(0)
    denoiser = make_denoiser(network)
    if compiled:
        denoiser.compile()
    optimizer = torch.optim.AdamW(denoiser.parameters(), 1e-3, fused=True)
    clean, condition = torch.randn(BATCH, 14, 19), torch.randn(BATCH, 38)

    def update() -> None:
        with torch.autocast("cpu", torch.bfloat16):
            predicted = denoiser(0.7 * clean + 0.7 * torch.randn_like(clean), torch.rand(BATCH), condition)
        (predicted - clean).square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()

    return update


def beside_bare() -> None:
    """Writes a row per network: times of an update in the loop and of bare updates (ms), and their ratios."""
    known = (torch.cpu.get_capabilities()["cpu_name"], int(has_bfloat16_units()))
    done, write = open_table(RESULTS / "training_loop.csv", LOOP, LOOP[:4])
    for network in ("mlp", "unet"):
        if tuple(map(str, (*known, network, BATCH))) in done:
            continue
        updates = [bare_update(network, compiled=compiled) for compiled in (False, True)]
        rounds = []
        for _ in range(3):
            bare = [1e3 * median_seconds(update, 60, warm_up=10) for update in updates]
            rounds.append((1e3 / loop_rate(network, device="cpu"), *bare))
        times = [sorted(column)[1] for column in zip(*rounds, strict=True)]
        row = (
            *known,
            network,
            BATCH,
            *(f"{each:.1f}" for each in times),
            *(f"{each / times[0]:.2f}" for each in times[1:]),
        )
        print(*row, flush=True)
        write(row)


def on_gpu() -> None:
    """Writes a row per network with the rates on the GPU of this machine and on one of its cores."""
    device = torch.cuda.get_device_name()
    done, write = open_table(RESULTS / "training_speed_cuda.csv", CUDA, CUDA[:4])
    for network in ("mlp", "unet"):
        key = (device, network, BATCH, "bfloat16")
        if tuple(map(str, key)) not in done:
            ways: tuple[dict[str, bool], ...] = ({}, {"compiled": True}, {"replay": True})
            rates = [*(loop_rate(network, device="cuda", **way) for way in ways), loop_rate(network, device="cpu")]
            row = (*key, *(f"{rate:.0f}" for rate in rates), f"{os.getloadavg()[0]:.0f} busy cores of {os.cpu_count()}")
            print(*row, flush=True)
            write(row)


def main(*, part: tuple[Literal["controller", "planner", "precision", "loop", "cuda"], ...], repeats: int = 40) -> None:
    """Measures the rows that the tables lack.

    Args:
        part: parts to measure.
        repeats: calls of which the median is taken.
    """
    torch.set_num_threads(1)
    done, write = open_table(RESULTS / "training_speed.csv", SPEED, SPEED[:2])
    for name, rows in (("controller", controllers), ("planner", planners)):
        for row in rows(repeats) if name in part else ():
            print(*row[:-1])
            if tuple(map(str, row[:2])) not in done:
                write(row)
    if "cuda" in part:
        on_gpu()
    if "loop" in part:
        beside_bare()
    if "precision" not in part:
        return
    known = (torch.cpu.get_capabilities()["cpu_name"], int(has_bfloat16_units()))
    done, write = open_table(RESULTS / "planner_precision.csv", PRECISION, PRECISION[:5])
    for size in SIZES:
        if tuple(map(str, (*known, *size))) not in done:
            rates = [1 / median_seconds(wide_update(*size, dtype), repeats) for dtype in (None, torch.bfloat16)]
            row = (*known, *size, *(f"{rate:.2f}" for rate in rates), f"{rates[1] / rates[0]:.2f}")
            print(*row)
            write(row)


if __name__ == "__main__":
    tyro.cli(main)
