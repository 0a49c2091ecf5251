# This source code is licensed under the MIT license found in the LICENSE file.
"""Control steps per second of AvoidingEnv, per core and over threads, against the original simulator.

    python benchmarks/env_speed.py --num-envs 60 --steps 40 --threads 1 2

The original (one environment, one core, Python controller) makes 26 control steps per second; ratios are against it.
"""

from __future__ import annotations

import argparse
import statistics
import time

import mujoco
import numpy as np
import torch

from torchrl_koap.envs import AvoidingEnv

ANCHOR = 26.0


def straight_on(env: AvoidingEnv):
    """A policy that moves at human speed through the scene, so that controller and contacts have work to do."""
    generator = torch.Generator().manual_seed(0)
    aim = torch.rand(env.batch_size[0], 2, generator=generator) * torch.tensor([0.012, 0.006])
    aim[:, 0] -= 0.006

    def policy(tensordict):
        return tensordict.set("action", aim)

    return policy


def rollout_speed(env: AvoidingEnv, steps: int, repeats: int) -> list[float]:
    """Control steps per second of ``env.rollout`` (TorchRL included), once per repeat."""
    policy = straight_on(env)
    env.rollout(2, policy, break_when_any_done=False)
    speeds = []
    for _ in range(repeats):
        tensordict = env.reset()
        start = time.perf_counter()
        env.rollout(steps, policy, break_when_any_done=False, auto_reset=False, tensordict=tensordict)
        speeds.append(env.batch_size[0] * steps / (time.perf_counter() - start))
    return speeds


def shares(env: AvoidingEnv, steps: int) -> dict[str, float]:
    """Microseconds per substep spent in the physics alone and in physics with controller (one thread)."""
    env.reset()
    rows = np.arange(env.batch_size[0])
    substeps = steps * env.substeps
    start = time.perf_counter()
    env.sims.track_pose(rows, env.commands, substeps)
    both = (time.perf_counter() - start) / (len(rows) * substeps)
    start = time.perf_counter()
    for data in env.sims.data:
        mujoco.mj_step(env.sims.model, data, nstep=substeps)
    physics = (time.perf_counter() - start) / (len(rows) * substeps)
    return {"physics": physics * 1e6, "physics and controller": both * 1e6}


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=60)
    parser.add_argument("--steps", type=int, default=40, help="control steps per measurement")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    torch.set_num_threads(1)

    base = None
    print("| batch | threads | control steps/s (min / median / max) | per thread, over the original's 26 | scaling |")
    print("|---|---|---|---|---|")
    for num_envs in (1, options.num_envs):
        for threads in options.threads if num_envs > 1 else [1]:
            env = AvoidingEnv(num_envs, num_threads=threads, max_steps=10**6)
            speeds = rollout_speed(env, options.steps, options.repeats)
            median = statistics.median(speeds)
            base = median if threads == 1 else base
            print(
                f"| {num_envs} | {threads} | {min(speeds):.0f} / {median:.0f} / {max(speeds):.0f}"
                f" | {median / threads / ANCHOR:.0f}x | {median / base:.2f}x |"
            )
    env = AvoidingEnv(options.num_envs, max_steps=10**6)
    print()
    for name, value in shares(env, options.steps).items():
        print(f"{name}: {value:.1f} us per substep")


if __name__ == "__main__":
    main()
