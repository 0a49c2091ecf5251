# This source code is licensed under the MIT license found in the LICENSE file.
"""How high the spoon is led through the bowl, by start position and outcome.

    koap eval RUN --episodes 60                 # or benchmarks/scooping.py, which leaves the same files
    python benchmarks/scooping_strokes.py --run runs/scooping/koap_both_5_2 runs/scooping/koap_both_100_2

The commands of recorded rollouts are played again in the simulation, without frames; an episode that ends otherwise
than recorded stops the script. A stroke is what is lower than 2 cm within three seconds of the first such frame. Rows
of the table are replaced by those of the runs given.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors.torch import load_file
from scooping_parts import whose_demonstrations
from tensordict import TensorDict
from torch import Tensor

from torchrl_koap.envs import ScoopingEnv
from torchrl_koap.tasks.scooping import FRAME_HZ, STARTS, start_of

TABLE = Path(__file__).parent / "results" / "scooping_strokes.csv"
COLUMNS = ("labels", "unlabelled", "method", "seed", "start", "success", "n", "height_mm", "height_sd", "pieces")
LOW = 0.02  # m
STROKE = round(3 * FRAME_HZ)  # frames


def stroke_height(heights: np.ndarray) -> float | None:
    """Median height (m) of the first stroke, None where the spoon never was low.

    Args:
        heights (np.ndarray): of the spoon after every command ``[T]`` (m).
    """
    low = np.flatnonzero(heights < LOW)
    return float(np.median(heights[low[low < low[0] + STROKE]])) if len(low) else None


def play_again(env: ScoopingEnv, rollouts: Mapping[str, Tensor], number: int) -> tuple[float | None, int]:
    """The height of the stroke (m) of a recorded rollout, and the most pieces that lay on the spoon at once.

    Raises:
        RuntimeError: if it does not end as recorded.
    """
    env.reset(contexts=rollouts["context"][number : number + 1].double().numpy())
    heights, pieces = [], 0
    for action in rollouts["action"][number, : int(rollouts["length"][number])]:
        env.step(TensorDict({"action": action[None]}, [1]))
        heights.append(float(env.sims.spoon_position[0, 2]))
        pieces = max(pieces, int(env.sims.pieces_on_spoon([0])[0]))
    if bool(env.sims.success[0]) != (int(rollouts["outcome"][number]) == 1):
        raise RuntimeError(f"rollout {number} does not end as recorded: was it made by another version?")
    return stroke_height(np.array(heights)), pieces


def rows_of(run: Path, env: ScoopingEnv) -> list[dict]:
    """A row per start position and outcome of a run's rollouts."""
    config, rollouts = json.loads((run / "config.json").read_text()), load_file(run / "rollouts.safetensors")
    cell = (len(config["label_episodes"]), whose_demonstrations(run), config["method"], config["seed"])
    found: dict[tuple[str, int], list[tuple[float | None, int]]] = {}
    for number, context in enumerate(rollouts["context"]):
        key = list(STARTS)[start_of(context.numpy())], int(rollouts["outcome"][number])
        found.setdefault(key, []).append(play_again(env, rollouts, number))
    rows = []
    for (start, success), episodes in sorted(found.items()):
        heights = [1000 * height for height, _ in episodes if height is not None]
        spread = f"{statistics.stdev(heights):.1f}" if len(heights) > 1 else ""
        mean = f"{statistics.fmean(heights):.1f}" if heights else ""
        pieces = f"{statistics.fmean(count for _, count in episodes):.1f}"
        rows.append(dict(zip(COLUMNS, (*cell, start, success, len(episodes), mean, spread, pieces), strict=True)))
    return rows


def main() -> None:
    """Measures the runs given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    options = parser.parse_args()
    env, made = ScoopingEnv(embed=False), []
    for run in options.run:
        made += rows_of(run, env)
        print(*made[-6:], sep="\n")
    known = list(csv.DictReader(TABLE.open())) if TABLE.is_file() else []
    cells = {tuple(str(row[key]) for key in COLUMNS[:4]) for row in made}
    kept = [row for row in known if tuple(row[key] for key in COLUMNS[:4]) not in cells]
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*kept, *made])


if __name__ == "__main__":
    main()
