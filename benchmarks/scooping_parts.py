# This source code is licensed under the MIT license found in the LICENSE file.
"""Which part of a scooping policy fails: physics, controller or planner, each looked at without the others.

    python benchmarks/scooping_parts.py --folder runs/scooping --run runs/scooping/koap_both_5_0

A row per part: how many of the episodes end with a piece out of the bowl, or for the planner, which moves nothing, with
the imagined spoon (a linear map from embeddings to its position) first in the bowl and later above it.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from scooping_alignment import spoon_reader
from tensordict import TensorDict

from torchrl_koap.data import load_ted
from torchrl_koap.envs.scooping.expert import ScoopingExpert, start_joints
from torchrl_koap.envs.scooping.simulation import LEFT_BOWL, ScoopingSimulations
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.evaluation.trained_run import load_run
from torchrl_koap.tasks.scooping import EMBEDDING_DIM, STARTS

TABLE = Path(__file__).parent / "results" / "scooping_parts.csv"
PARTS = ("expert", "replay", "controller", "planner")
MOST_STEPS = 120
IN_BOWL = 0.03  # m; lower than that the imagined spoon is among the pieces
ROBOTS = 100  # the first demonstrations of a data set are the robot's
TURN = 1.0  # rad; the pieces lie otherwise than in the demonstration


def play(sims: ScoopingSimulations, start: np.ndarray, turn: float, actions: Iterable[np.ndarray]) -> bool:
    """Whether joint targets, played one after the other, take a piece out."""
    rows = np.zeros(1, dtype=np.int64)
    sims.reset(rows, start_joints(np.array([[*start, turn]]), "robot")[None], [turn])
    for action in actions:
        sims.advance(rows, action[None])
    return bool(sims.success[0])


def experts(sims: ScoopingSimulations, episodes: int) -> tuple[int, int]:
    """Successes of the scripted robot, and of its joint targets among pieces that lie otherwise."""
    taken, again, places = 0, 0, np.array(list(STARTS.values()))
    for number in range(episodes):
        generator = np.random.default_rng((11, number))
        start = places[number % 3] + generator.uniform(-0.02, 0.02, 2)
        turn = generator.uniform(-np.pi, np.pi - TURN)
        rows, targets = np.zeros(1, dtype=np.int64), []
        sims.reset(rows, start_joints(np.array([[*start, turn]]), "robot")[None], [turn])
        expert = ScoopingExpert(sims, 0, number % 3, (11, number))
        while len(targets) < MOST_STEPS:
            target = expert.target()
            if expert.finished:
                break
            targets.append(target)
            sims.advance(rows, target[None])
        taken += bool(sims.success[0])
        again += play(sims, start, turn + TURN, targets)
    return taken, again


def decoded(sims: ScoopingSimulations, run, states: list[torch.Tensor]) -> int:
    """Successes of joint targets that the controller reads off the frames of demonstrations without labels."""
    controller, taken = run.controller, 0
    for seen in states:
        past, ahead = controller.num_past, controller.num_window_frames
        frames = seen[:, :EMBEDDING_DIM].float()
        window = torch.cat([frames[:1].expand(past, -1), frames, frames[-1:].expand(ahead, -1)])
        out = controller(TensorDict({controller.in_keys[0]: window[None]}, [1])).get(controller.out_keys[-1])
        actions = out[0, past : past + len(frames)].double().numpy()
        taken += play(sims, seen[0, EMBEDDING_DIM : EMBEDDING_DIM + 2].numpy(), TURN, actions)
    return taken


def imagined(run, states: list[torch.Tensor], steps: int) -> int:
    """How often the planner, which is shown the first frame and then its own plans, lifts the spoon out of the bowl."""
    read = spoon_reader(torch.cat(states).double())
    planner, generator = run.planner, torch.Generator().manual_seed(0)
    path = [torch.stack([part[0, :EMBEDDING_DIM] for part in states]).float()] * planner.history
    while len(path) < MOST_STEPS:
        plan = planner.plan(torch.stack(path[-planner.history :], 1), generator=generator)
        path += list(plan[:, :steps].unbind(1))
    heights = read(torch.stack(path, 1).double())[..., 2]
    lowest = heights.argmin(1)
    return sum(
        bool(own[low] < IN_BOWL and own[low:].max() > LEFT_BOWL) for own, low in zip(heights, lowest, strict=True)
    )


def whose_demonstrations(run: Path) -> str:
    """Whose unlabelled demonstrations a run of ``benchmarks/scooping.py`` was trained on."""
    folder = Path(json.loads((run / "config.json").read_text())["dataset"]).name
    return re.fullmatch(r"data_([a-z_]+?)(_\d+)?", folder)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True, help="of benchmarks/scooping.py")
    parser.add_argument("--run", type=Path, nargs="+", required=True, help="runs whose parts are looked at")
    parser.add_argument("--episodes", type=int, default=15)
    parser.add_argument("--steps", type=int, default=8, help="frames of each imagined plan that are kept")
    options = parser.parse_args()
    torch.set_num_threads(1)
    data = load_ted(options.folder / "data_both" / "ted")
    states = [data["observation"][data["episode"] == e] for e in range(ROBOTS - options.episodes, ROBOTS)]
    sims, n = ScoopingSimulations("robot", 1), options.episodes
    taken, again = experts(sims, n)
    rows = [("expert", "", "", taken), ("replay", "", "", again)]
    with torch.no_grad():
        for path in options.run:
            run = load_run(path)
            whose = whose_demonstrations(path)
            rows.append(("controller", run.method.name, whose, decoded(sims, run, states)))
            if ("planner", whose) not in {(part, of) for part, _, of, _ in rows}:
                rows.append(("planner", "", whose, imagined(run, states, options.steps)))
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["part", "method", "unlabelled", "n", "successes", "success_low", "success_high"])
        for part, method, whose, count in rows:
            writer.writerow([part, method, whose, n, count, *(f"{value:.4f}" for value in wilson_interval(count, n))])


if __name__ == "__main__":
    main()
