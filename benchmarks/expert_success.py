# This source code is licensed under the MIT license found in the LICENSE file.
"""First attempts of the scripted experts on the 60 evaluation contexts: how many end as the mode asked for.

    python benchmarks/expert_success.py --tasks aligning sorting sorting_2 sorting_6 stacking
    python benchmarks/expert_success.py --tasks aligning sorting --disturbed    # pushed, slipping, late at turns

Modes are taken in turn. An attempt counts only if the task's environment reports success, in the mode asked for, within
the step limit; nothing is repeated.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
import torch

from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.envs.experts.disturbances import Disturbances
from torchrl_koap.envs.experts.recording import play
from torchrl_koap.envs.registry import make_env
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.tasks import get_task


def main() -> None:
    """Prints a row per task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["aligning", "sorting", "sorting_2", "sorting_6", "stacking"])
    parser.add_argument("--contexts", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--disturbed", action="store_true", help="disturb the operator in every episode")
    options = parser.parse_args()
    print("| task | first attempts that succeed | % (95 %) | per mode | control steps, median (range) | seconds |")
    print("|---|---|---|---|---|---|")
    for name in options.tasks:
        task, contexts = get_task(name), evaluation_contexts(name, options.contexts)
        rows = np.arange(len(contexts))
        modes = [int(row) % task.num_modes for row in rows]
        env = make_env(task, len(rows), num_threads=options.threads, dtype=torch.float64)
        start = time.perf_counter()
        seeds = [(options.seed, int(row)) for row in rows]
        hand = Disturbances(task, seeds, [True] * len(seeds)) if options.disturbed else None
        results = play(env, task, rows, modes, contexts, seeds, lambda over: None, disturbances=hand)
        env.close()
        good = [episode is not None for episode, _ in results]
        low, high = wilson_interval(sum(good), len(good))
        share = [sum(g for g, m in zip(good, modes, strict=True) if m == mode) for mode in range(task.num_modes)]
        lengths = [len(episode) for episode, _ in results if episode is not None]
        steps = f"{statistics.median(lengths):.0f} ({min(lengths)}-{max(lengths)})"
        rate = f"{100 * sum(good) / len(good):.1f} ({100 * low:.1f}-{100 * high:.1f})"
        seconds = time.perf_counter() - start
        print(f"| {name} | {sum(good)}/{len(good)} | {rate} | {share} | {steps} | {seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
