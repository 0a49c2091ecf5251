# This source code is licensed under the MIT license found in the LICENSE file.
"""Why episodes of Avoiding end at a cylinder: the plan itself, the way it is followed, or a change of mind.

    python benchmarks/collision_causes.py RUN

Reads the rollouts of the last evaluation of RUN. For every collision: the clearance of the plan in force and of the one
before it (distance of the rod's surface to the cylinder that was hit, along the next steps; below 0 the plan itself
collides), how far the executed path lay from the plan in force, and whether the two plans pass that cylinder on
different sides.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from torchrl_koap.envs.avoiding import OBSTACLES
from torchrl_koap.envs.experts.avoiding import ROD_RADIUS
from torchrl_koap.evaluation.scores import OUTCOMES
from torchrl_koap.runs.weights import load_tensors


def clearance(path: np.ndarray, centre: np.ndarray, radius: float) -> float:
    """Least gap (mm) between the rod on a path ``[T, 2]``, straight between its points, and a cylinder."""
    starts, ways = path[:-1], np.diff(path, axis=0)
    lengths = np.maximum((ways**2).sum(1), 1e-12)
    share = np.clip(((centre - starts) * ways).sum(1) / lengths, 0, 1)
    return 1e3 * (np.linalg.norm(starts + share[:, None] * ways - centre, axis=1).min() - radius - ROD_RADIUS)


def side(path: np.ndarray, centre: np.ndarray) -> float:
    """Left (-1) or right (1) of a cylinder where a path is nearest to it."""
    return float(np.sign(path[np.linalg.norm(path - centre, axis=1).argmin(), 0] - centre[0]))


def main() -> None:
    """Prints a line per collision and the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    run = parser.parse_args().run
    rollouts, _ = load_tensors(run / "rollouts.safetensors")
    rollouts = {name: tensor.numpy() for name, tensor in rollouts.items()}
    errors, sums = [], {"collisions": 0, "plan collides": 0, "plan clear, not followed": 0, "changed side": 0}
    for episode, length in enumerate(rollouts["length"]):
        path, steps = rollouts["position"][episode][: length + 1], rollouts["plan_step"][episode]
        plans = {int(step): plan for step, plan in zip(steps, rollouts["plan"][episode], strict=True) if step >= 0}
        for step, plan in plans.items():
            followed = path[step + 1 : step + 5]
            errors.append(1e3 * np.linalg.norm(followed - plan[: len(followed)], axis=1).mean() if len(followed) else 0)
        if rollouts["outcome"][episode] != OUTCOMES.index("collision"):
            continue
        end = path[-1]
        gaps = [np.linalg.norm(end - (x, y)) - radius for _, x, y, radius, _ in OBSTACLES]
        name, x, y, radius, _ = OBSTACLES[int(np.argmin(gaps))]
        centre = np.array([x, y])
        last = max(plans)
        whole = {step: np.concatenate([path[step : step + 1], plans[step]]) for step in plans}
        own = [clearance(whole[step], centre, radius) for step in sorted(plans)[-4:]]
        sides = [side(whole[step], centre) for step in sorted(plans)[-4:]]
        error = 1e3 * np.linalg.norm(path[last + 1 : length + 1] - plans[last][: length - last], axis=1).max()
        sums["collisions"] += 1
        sums["plan collides"] += min(own[-2:]) < 0
        sums["plan clear, not followed"] += min(own[-2:]) >= 0
        sums["changed side"] += len(set(sides)) > 1
        numbers = " ".join(f"{gap:.1f}" for gap in own)
        print(
            f"episode {episode}: {name}, step {length}, clearance of the last plans {numbers} mm, sides {sides},"
            f" off the plan by {error:.1f} mm"
        )
    print(sums, f"mean distance to the plan {np.mean(errors):.2f} mm over {len(errors)} plans")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
