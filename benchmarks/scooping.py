# This source code is licensed under the MIT license found in the LICENSE file.
"""Scooping from pixels: what demonstrations of another embodiment are worth.

    python benchmarks/scooping.py --folder runs/scooping
    python benchmarks/scooping.py --folder runs/scooping --methods koap linear dd --labels 2 5 20 --unlabelled both

Records robot and hand, embeds, trains one planner per set of unlabelled demonstrations and one controller per cell, and
rolls each out. Folder by folder what is there already is not made again, and rows of the table are not run again.

Unlabelled demonstrations are those of the robot, of the hand (then the robot's labelled ones are all there is of it),
or both. Labelled ones are the robot's first: they begin at the three start positions in turn.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from pathlib import Path

import torch

from torchrl_koap.data.lerobot.images import read_image_episodes
from torchrl_koap.envs.experts.scooping_recording import record_videos
from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.modules.policies.plan_then_control import EXECUTIONS
from torchrl_koap.tasks.scooping import EMBEDDING_DIM, EMBODIMENTS
from torchrl_koap.training import TrainConfig, train
from torchrl_koap.vision.backbones import load_backbone
from torchrl_koap.vision.demonstrations import Source, embed_demonstrations, fit_projection
from torchrl_koap.vision.encoder import FrozenImageEncoder
from torchrl_koap.vision.pooling import POOLINGS, Projection
from torchrl_koap.vision.projections import SCOOPING, load_encoder, save_encoder

RESULTS = Path(__file__).parent / "results"
TABLE, PROBES = RESULTS / "scooping.csv", RESULTS / "scooping_probe.csv"
UNLABELLED = ("robot", "hand", "both")
METHODS = ["koap", "koap_paper", "dd", "vae", "lapo", "dp", "pca", "linear"]
COLUMNS = (
    "labels", "unlabelled", "method", "execution", "seed", "n", "successes", "success_low", "success_high", "rims",
    "rim_low", "rim_high", "left", "near", "right", "action_error_mrad", "planner_steps", "planner_error",
)  # fmt: skip
HELD_OUT = 0.25  # share of the demonstrations that probes are judged on


def data_set(folder: Path, unlabelled: str, labels: int) -> Path:
    """The data set of a cell, embedded where it is not there."""
    out = folder / (f"data_hand_{labels}" if unlabelled == "hand" else f"data_{unlabelled}")
    if not (out / "ted").is_dir():
        robot, hand = Source(folder / "robot", embodiment="robot"), Source(folder / "hand", embodiment="hand")
        sources = {"robot": [robot], "both": [robot, hand], "hand": [Source(folder / "robot", labels), hand]}
        encoder = load_encoder(cache=folder / "cache")
        embed_demonstrations(out, sources[unlabelled], encoder, mixed=unlabelled != "robot")
    return out


def planner_of(folder: Path, unlabelled: str, labels: int, seed: int, steps: int) -> Path:
    """A run that holds the planner of a cell, trained where it is not there."""
    name = f"planner_{unlabelled}{f'_{labels}' if unlabelled == 'hand' else ''}_{seed}"
    run = folder / name
    if not (run / "summary.json").is_file():
        options = {"method": "linear", "steps": steps, "seed": seed, "analysis": False, "resume": run.exists()}
        train(_config(run, folder, unlabelled, labels, **options))
    return run


def _config(run: Path, folder: Path, unlabelled: str, labels: int, **options) -> TrainConfig:
    known = {"task": "scooping", "dataset": str(data_set(folder, unlabelled, labels))}
    return TrainConfig(out=run, label_episodes=tuple(range(labels)), **known, **options)


def run_cell(folder: Path, unlabelled: str, labels: int, method: str, seed: int, options) -> dict:
    """Trains and rolls out one cell."""
    run = folder / f"{method}_{unlabelled}_{labels}_{seed}"
    planner = None
    if not method.startswith("dp"):
        planner = planner_of(folder, unlabelled, labels, seed, options.steps)
    if not (run / "summary.json").is_file():
        shutil.rmtree(run, ignore_errors=True)
        settings = {"method": method, "seed": seed, "planner_from": planner, "steps": options.steps}
        settings |= {"controller_steps": options.controller_steps, "analysis": unlabelled != "hand"}
        train(_config(run, folder, unlabelled, labels, **settings))
    ways = {name: getattr(options, name) for name in ("execution", "replan_interval", "blend_decay")}
    result = evaluate(run, EvalConfig(episodes=options.episodes, threads=1, **ways))
    summary = json.loads((run / "summary.json").read_text())
    n = options.episodes
    successes, rims = round(result["success_rate"] * n), round(result["rim_rate"] * n)
    spans = [f"{value:.4f}" for count in (successes, rims) for value in wilson_interval(count, n)]
    errors = summary.get("action_error_mrad") or {}
    made = json.loads(((planner or run) / "summary.json").read_text())["planner"]
    return dict(
        zip(
            COLUMNS,
            (
                labels, unlabelled, method, options.execution, seed, n, successes, *spans[:2], rims, *spans[2:],
                *(f"{result[f'success_{start}']:.3f}" for start in ("left", "near", "right")),
                f"{errors['controller']:.1f}" if errors else "", options.steps,
                f"{made.get('loss_planner', float('nan')):.4f}",
            ),
            strict=True,
        )
    )  # fmt: skip


def probe(folder: Path) -> list[dict]:
    """Errors of a linear map from embeddings to the spoon's position, by pooling: what the embedding keeps of it."""
    backbone, poolings = load_backbone(), ("average", "spatial_softmax", "grid")
    features, spoons = {}, {}
    with torch.no_grad():
        for who in EMBODIMENTS:
            read = read_image_episodes(folder / who)
            spoons[who] = [torch.from_numpy(episode.state).double() for episode in read]
            maps = (backbone(torch.from_numpy(e.frames).permute(0, 3, 1, 2).float() / 255) for e in read)
            features[who] = [{pooling: POOLINGS[pooling](part) for pooling in poolings} for part in maps]
    rows = []
    for pooling in poolings:
        every = torch.cat([part[pooling] for parts in features.values() for part in parts])
        chosen = torch.randperm(len(every), generator=torch.Generator().manual_seed(0))[:3000]
        fitted = Projection.fit(every[chosen], min(EMBEDDING_DIM, every.shape[1] - 1))
        for who, parts in features.items():
            seen = [torch.cat([fitted(p[pooling]).double(), torch.ones(len(p[pooling]), 1)], 1) for p in parts]
            cut = round(len(seen) * (1 - HELD_OUT))
            x, y = torch.cat(seen[:cut]), torch.cat(spoons[who][:cut])
            weight = torch.linalg.solve(x.T @ x + 1e-3 * torch.eye(x.shape[1]).double(), x.T @ y)
            errors = (torch.cat(seen[cut:]) @ weight - torch.cat(spoons[who][cut:])).norm(dim=1) * 1000
            rows.append(
                {"pooling": pooling, "columns": fitted.dim, "embodiment": who, "demonstrations": cut}
                | {"held_out": len(seen) - cut, "error_mm": f"{errors.mean():.1f}"}
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--demonstrations", type=int, default=100)
    parser.add_argument(
        "--methods", nargs="+", default=["koap", "koap_paper", "dd", "vae", "lapo", "dp", "pca", "linear"]
    )
    parser.add_argument("--labels", type=int, nargs="+", default=[5, 2, 20])
    parser.add_argument("--unlabelled", nargs="+", choices=UNLABELLED, default=list(UNLABELLED))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--episodes", type=int, default=15)
    parser.add_argument("--steps", type=int, default=2000, help="planner updates")
    parser.add_argument("--controller-steps", type=int, default=200)
    parser.add_argument("--replan-interval", type=int, default=8, help="frames of each plan that are executed")
    parser.add_argument("--execution", choices=EXECUTIONS, default="open_loop", help="of plans")
    parser.add_argument("--blend-decay", type=float, default=0.0, help="of plans; 0 leaves them as they are")
    parser.add_argument("--probe", action="store_true", help="write the table of the probes and stop")
    parser.add_argument("--fit-projection", action="store_true", help="make the package's projection anew and stop")
    options = parser.parse_args()
    for who in EMBODIMENTS:
        if not (options.folder / who).exists():
            record_videos(options.folder / who, who, options.demonstrations)
    if options.fit_projection:
        encoder = FrozenImageEncoder(load_backbone(), pooling="grid", cache=options.folder / "cache")
        encoder.projection = fit_projection(
            encoder, [Source(options.folder / who) for who in EMBODIMENTS], EMBEDDING_DIM
        )
        save_encoder(encoder, SCOOPING, stride=8, fitted_on="unlabelled frames of robot and hand, koap demos, seed 0")
        return
    if options.probe:
        rows = probe(options.folder)
        with PROBES.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        return
    keys = COLUMNS[:6]
    done = []
    if TABLE.exists():
        with TABLE.open(newline="") as file:
            done = [tuple(row[key] for key in keys) for row in csv.DictReader(file)]
    for seed in options.seeds:
        for unlabelled in options.unlabelled:
            for labels in options.labels:
                for method in options.methods:
                    cell = tuple(map(str, (labels, unlabelled, method, options.execution, seed, options.episodes)))
                    if cell in done:
                        continue
                    row = run_cell(options.folder, unlabelled, labels, method, seed, options)
                    new = not TABLE.exists()
                    with TABLE.open("a", newline="") as file:
                        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                        if new:
                            writer.writeheader()
                        writer.writerow(row)
                    print(row, flush=True)


if __name__ == "__main__":
    main()
