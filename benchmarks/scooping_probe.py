# This source code is licensed under the MIT license found in the LICENSE file.
"""What an embedding keeps of the spoon's place: errors of a linear map from it to the spoon's position.

    python benchmarks/scooping_probe.py --folder runs/scooping

Principal components of pooled features are fitted on frames without labels; the map is fitted on three quarters of each
embodiment's demonstrations and judged on the others. The spoon's position is the simulator's, and no policy sees it.
Frames of another size than the recorded one are drawn anew, of the same demonstrations.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torchrl_koap.vision.pooling import POOLINGS, Projection

from torchrl_koap.data.lerobot.images import ImageEpisode, read_image_episodes
from torchrl_koap.envs.scooping.recording import play_episodes
from torchrl_koap.tasks.scooping import EMBEDDING_DIM, EMBODIMENTS, IMAGE_SIZE
from torchrl_koap.vision.backbones import load_backbone
from torchrl_koap.vision.encoder import BATCH

TABLE = Path(__file__).parent / "results" / "scooping_probe.csv"
HELD_OUT = 0.25  # share of the demonstrations that the map is judged on
MOST = 3000  # frames that components are fitted on
RIDGE = 1e-3
KEYS = ("pixels", "pooling", "columns", "embodiment")  # what tells rows apart


def frames_of(folder: Path, embodiment: str, size: int, seed: int = 0) -> Iterable[ImageEpisode]:
    """The recorded demonstrations of an embodiment, played again where their frames have another size."""
    recorded = read_image_episodes(folder / embodiment)
    if recorded[0].frames.shape[1] == size:
        return recorded
    return (episode for episode, _, _ in play_episodes(embodiment, len(recorded), seed, size=size))


@torch.no_grad()
def pooled(episodes: Iterable[ImageEpisode], poolings: Sequence[str]) -> tuple[dict[str, list[Tensor]], list[Tensor]]:
    """Features by pooling, and positions of the spoon, an entry per demonstration.

    Args:
        episodes (iterable of ImageEpisode): the demonstrations.
        poolings (sequence of str): names in :data:`POOLINGS`.
    """
    backbone, spoons = load_backbone(), []
    features: dict[str, list[Tensor]] = {name: [] for name in poolings}
    for episode in episodes:
        pictures = torch.from_numpy(episode.frames).permute(0, 3, 1, 2).float() / 255
        maps = torch.cat([backbone(part) for part in pictures.split(BATCH)])
        for name, parts in features.items():
            parts.append(POOLINGS[name](maps).half())
        spoons.append(torch.from_numpy(episode.state).double())
    return features, spoons


def probe_error(seen: Sequence[Tensor], spoons: Sequence[Tensor], cut: int) -> float:
    """Mean distance (mm) of a linear map's spoon from the true one.

    Args:
        seen (sequence of Tensor): embeddings ``[T_i, d]`` of every demonstration.
        spoons (sequence of Tensor): positions ``[T_i, 3]`` (m).
        cut (int): demonstrations that the map is fitted on; the others judge it.
    """
    design = [torch.cat([part.double(), torch.ones(len(part), 1).double()], 1) for part in seen]
    x, y = torch.cat(design[:cut]), torch.cat(list(spoons[:cut]))
    weight = torch.linalg.solve(x.T @ x + RIDGE * torch.eye(x.shape[1]).double(), x.T @ y)
    off = torch.cat(design[cut:]) @ weight - torch.cat(list(spoons[cut:]))
    return 1000 * off.norm(dim=1).mean().item()


def write(table: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Writes rows; those that the table has of other sizes, poolings, columns or embodiments stay."""
    made = [{key: str(value) for key, value in row.items()} for row in rows]
    if table.exists():
        with table.open(newline="") as file:
            there = list(csv.DictReader(file))
        again = {tuple(row[key] for key in KEYS) for row in made}
        made = [row for row in there if tuple(row.get(key) for key in KEYS) not in again] + made
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(made)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True, help="of benchmarks/scooping.py")
    parser.add_argument("--poolings", nargs="+", choices=sorted(POOLINGS), default=list(POOLINGS))
    parser.add_argument("--columns", type=int, nargs="+", default=[EMBEDDING_DIM, 2 * EMBEDDING_DIM, 4 * EMBEDDING_DIM])
    parser.add_argument("--sizes", type=int, nargs="+", default=[IMAGE_SIZE], help="pixels of the frames, both ways")
    options = parser.parse_args()
    rows = []
    for size in options.sizes:
        found = {who: pooled(frames_of(options.folder, who, size), options.poolings) for who in EMBODIMENTS}
        for pooling in options.poolings:
            every = torch.cat([part for features, _ in found.values() for part in features[pooling]])
            chosen = torch.randperm(len(every), generator=torch.Generator().manual_seed(0))[:MOST]
            for columns in sorted({min(columns, every.shape[1] - 1) for columns in options.columns}):
                fitted = Projection.fit(every[chosen].float(), columns)
                for who, (features, spoons) in found.items():
                    cut = round(len(spoons) * (1 - HELD_OUT))
                    error = probe_error([fitted(part.float()) for part in features[pooling]], spoons, cut)
                    about = {"pixels": size, "pooling": pooling, "features": every.shape[1], "columns": columns}
                    about |= {"embodiment": who, "demonstrations": cut, "held_out": len(spoons) - cut}
                    rows.append(about | {"error_mm": f"{error:.1f}"})
                    print(rows[-1], flush=True)
    write(TABLE, rows)


if __name__ == "__main__":
    main()
