# This source code is licensed under the MIT license found in the LICENSE file.
"""Where the spoon enters the bowl and how high it is led through, by start position and outcome.

    koap eval RUN --episodes 60                 # or benchmarks/scooping.py, which leaves the same files
    python benchmarks/scooping_strokes.py --run runs/scooping/koap_both_5_2 runs/scooping/koap_both_100_2

The commands of recorded rollouts are played again in the simulation, without frames; an episode that ends otherwise
than recorded stops the script. A stroke is what is lower than 2 cm within three seconds of the first such frame; it
enters the bowl there, so far from where the robot's demonstrations from that start do on average. Rows of the table are
replaced by those of the runs given.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from safetensors.torch import load_file
from scooping_parts import whose_demonstrations
from tensordict import TensorDict
from torch import Tensor

from torchrl_koap.data import load_ted
from torchrl_koap.envs import ScoopingEnv
from torchrl_koap.tasks.scooping import EMBEDDING_DIM, FRAME_HZ, STARTS, start_of

TABLE = Path(__file__).parent / "results" / "scooping_strokes.csv"
COLUMNS = (
    "labels", "unlabelled", "method", "seed", "start", "success", "n", "height_mm", "height_sd", "pieces",
    "entry_mm", "entry_sd",
)  # fmt: skip
LOW = 0.02  # m
STROKE = round(3 * FRAME_HZ)  # frames


def stroke_height(heights: np.ndarray) -> float | None:
    """Median height (m) of the first stroke, None where the spoon never was low.

    Args:
        heights (np.ndarray): of the spoon after every command ``[T]`` (m).
    """
    low = np.flatnonzero(heights < LOW)
    return float(np.median(heights[low[low < low[0] + STROKE]])) if len(low) else None


def entry_of(spoon: np.ndarray) -> np.ndarray | None:
    """Where the spoon first is low ``[2]`` (m), None where it never is.

    Args:
        spoon (np.ndarray): its positions ``[T, 3]`` (m).
    """
    low = np.flatnonzero(spoon[:, 2] < LOW)
    return spoon[low[0], :2] if len(low) else None


def usual_entries(data: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Mean place ``[2]`` (m) where the robot's demonstrations from each start enter the bowl.

    Args:
        data (mapping): flat data with the robot's steps labelled and the spoon's position in its observations.
    """
    robot = data["has_action"].reshape(-1)
    spoon, episode = data["observation"][robot, EMBEDDING_DIM : EMBEDDING_DIM + 3].numpy(), data["episode"][robot]
    found: dict[str, list[np.ndarray]] = {}
    for number in episode.unique():
        own = spoon[(episode == number).numpy()]
        entry = entry_of(own)
        if entry is not None:
            found.setdefault(list(STARTS)[start_of(own[:1])], []).append(entry)
    return {start: np.mean(entries, 0) for start, entries in found.items()}


def play_again(env: ScoopingEnv, rollouts: Mapping[str, Tensor], number: int) -> tuple[np.ndarray, int]:
    """The spoon's positions ``[T, 3]`` (m) in a recorded rollout, and the most pieces that lay on it at once.

    Raises:
        RuntimeError: if it does not end as recorded.
    """
    env.reset(contexts=rollouts["context"][number : number + 1].double().numpy())
    spoon, pieces = [], 0
    for action in rollouts["action"][number, : int(rollouts["length"][number])]:
        env.step(TensorDict({"action": action[None]}, [1]))
        spoon.append(env.sims.spoon_position[0].copy())
        pieces = max(pieces, int(env.sims.pieces_on_spoon([0])[0]))
    if bool(env.sims.success[0]) != (int(rollouts["outcome"][number]) == 1):
        raise RuntimeError(f"rollout {number} does not end as recorded: was it made by another version?")
    return np.array(spoon), pieces


def rows_of(run: Path, env: ScoopingEnv) -> list[dict]:
    """A row per start position and outcome of a run's rollouts."""
    config, rollouts = json.loads((run / "config.json").read_text()), load_file(run / "rollouts.safetensors")
    cell = (len(config["label_episodes"]), whose_demonstrations(run), config["method"], config["seed"])
    usual = usual_entries(load_ted(Path(config["dataset"]) / "ted"))
    found: dict[tuple[str, int], list[tuple[np.ndarray, int]]] = {}
    for number, context in enumerate(rollouts["context"]):
        key = list(STARTS)[start_of(context.numpy())], int(rollouts["outcome"][number])
        found.setdefault(key, []).append(play_again(env, rollouts, number))
    rows = []
    for (start, success), episodes in sorted(found.items()):
        heights = [stroke_height(spoon[:, 2]) for spoon, _ in episodes]
        entries = [entry_of(spoon) for spoon, _ in episodes]
        off = [float(np.linalg.norm(entry - usual[start])) for entry in entries if entry is not None]
        pieces = f"{statistics.fmean(count for _, count in episodes):.1f}"
        measured = (*_mean_and_spread([height for height in heights if height is not None]), pieces)
        row = (*cell, start, success, len(episodes), *measured, *_mean_and_spread(off))
        rows.append(dict(zip(COLUMNS, row, strict=True)))
    return rows


def _mean_and_spread(lengths: Sequence[float]) -> tuple[str, str]:
    """Mean and standard deviation in mm of lengths in m; empty where there are too few."""
    mean = f"{1000 * statistics.fmean(lengths):.1f}" if lengths else ""
    return mean, f"{1000 * statistics.stdev(lengths):.1f}" if len(lengths) > 1 else ""


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
