# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures control steps per second of the environments by threads, relative to the original simulator.

    python benchmarks/env_speed.py --task avoiding --num-envs 60 --steps 40 --threads 1 2
    python benchmarks/env_speed.py --task aligning --num-envs 30 --steps 150 --recordings d3il_reference

The original (one environment, one core, Python controller) makes 19 to 80 control steps per second, depending on the
task; ratios are relative to that. With ``--recordings`` every environment plays the first recorded episode of the task,
pushes and grasps included. Otherwise the robot moves in a fixed direction at human speed.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import time
from pathlib import Path

import mujoco
import numpy as np
import torch

from torchrl_koap.envs import ManipulationEnv
from torchrl_koap.envs.registry import make_env

# control steps per second of the original on one core (docs/appendix/d3il.md, Repeatability)
ANCHORS = {"avoiding": 26.0, "aligning": 27.5, "sorting": 19.0, "stacking": 80.5}


def straight_on(env: ManipulationEnv):
    """Returns a policy that moves through the scene at human speed, so that controller and contacts are exercised."""
    generator = torch.Generator().manual_seed(0)
    spec = env.action_spec
    aim = torch.rand(spec.shape, generator=generator) * (spec.high - spec.low) / 2 + spec.low / 2
    if env.task.tool_kinematics is not None:
        aim = aim * 0.1
    else:
        aim[:, 1] = aim[:, 1].abs()

    def policy(tensordict):
        return tensordict.set("action", aim)

    return policy


def recorded(env: ManipulationEnv, file: Path):
    """Returns a policy that plays the first recorded episode, and the episode's context."""
    data = np.load(file)
    commands, context = torch.from_numpy(data["ep0_action"]), None
    if env.task.objects:
        rows = data["ep0_context"][: len(env.task.objects), :3] * (1, 1, math.pi / 180)
        context = np.repeat(rows[None], env.batch_size[0], 0)
    columns = 7 if env.task.tool_kinematics is not None else env.task.action_dim
    steps = itertools.count()

    def policy(tensordict):
        target = commands[min(next(steps), len(commands) - 1)]
        delta = target[:columns] - torch.from_numpy(env.commands[:, :columns])
        rest = target[columns : env.task.action_dim].expand(len(delta), -1)
        return tensordict.set("action", torch.cat([delta, rest], -1).float())

    return policy, context


def rollout_speed(env: ManipulationEnv, steps: int, repeats: int, file: Path | None) -> list[float]:
    """Returns the control steps per second of ``env.rollout`` (TorchRL included), one value per repeat."""
    env.rollout(2, straight_on(env), break_when_any_done=False)
    speeds = []
    for _ in range(repeats):
        policy, context = (straight_on(env), None) if file is None else recorded(env, file)
        tensordict = env.reset() if context is None else env.reset(contexts=context)
        start = time.perf_counter()
        env.rollout(steps, policy, break_when_any_done=False, auto_reset=False, tensordict=tensordict)
        speeds.append(env.batch_size[0] * steps / (time.perf_counter() - start))
    return speeds


def shares(env: ManipulationEnv, steps: int) -> dict[str, float]:
    """Returns microseconds per substep of the physics alone and of physics with controller (one thread)."""
    env.reset()
    if env.task.tool_kinematics is not None:
        return {}
    rows = np.arange(env.batch_size[0])
    substeps = steps * env.SUBSTEPS
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
    parser.add_argument("--task", default="avoiding", choices=sorted(ANCHORS))
    parser.add_argument("--recordings", type=Path, help="folder d3il_reference")
    parser.add_argument("--num-envs", type=int, default=60)
    parser.add_argument("--steps", type=int, default=40, help="control steps per measurement")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    torch.set_num_threads(1)

    base, anchor = None, ANCHORS[options.task]
    file = None if options.recordings is None else options.recordings / f"{options.task}.npz"
    head = "control steps/s (min / median / max) | per thread, over the original's"
    print(f"| {options.task}, batch | threads | {head} {anchor} | scaling |")
    print("|---|---|---|---|---|")
    for num_envs in (1, options.num_envs):
        for threads in options.threads if num_envs > 1 else [1]:
            env = make_env(options.task, num_envs, num_threads=threads, max_steps=10**6)
            speeds = rollout_speed(env, options.steps, options.repeats, file)
            median = statistics.median(speeds)
            base = median if threads == 1 else base
            print(
                f"| {num_envs} | {threads} | {min(speeds):.0f} / {median:.0f} / {max(speeds):.0f}"
                f" | {median / threads / anchor:.0f}x | {median / base:.2f}x |"
            )
    env = make_env(options.task, options.num_envs, max_steps=10**6)
    print()
    for name, value in shares(env, options.steps).items():
        print(f"{name}: {value:.1f} us per substep")


if __name__ == "__main__":
    main()
