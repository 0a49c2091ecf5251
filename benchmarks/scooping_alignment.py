# This source code is licensed under the MIT license found in the LICENSE file.
"""How far the hand's embeddings lie from where the robot's would be, before and after they are aligned.

    python benchmarks/scooping_alignment.py --folder runs/scooping

A linear map from embeddings to the spoon's position, fitted on robot demonstrations that are not aligned to, reads the
hand's frames; its error says how far off a frame is, in mm. The positions are read for this alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from resumable_table import open_table
from torch import Tensor

from torchrl_koap.data import load_ted
from torchrl_koap.tasks.scooping import EMBEDDING_DIM
from torchrl_koap.vision.alignment import fit_alignment

TABLE = Path(__file__).parent / "results" / "scooping_alignment.csv"
COLUMNS = ("robots", "hands", "moved", "error_mm", "same_start")
NEAR = 0.1  # m; partners that begin further apart begin at another of the three starts


def main() -> None:
    """Adds what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="of benchmarks/scooping.py, with data_both")
    parser.add_argument("--robots", type=int, nargs="+", default=[2, 3, 5, 6, 20], help="demonstrations to align to")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    data = load_ted(options.folder / "data_both" / "ted")
    parts = [data["observation"][data["episode"] == number].double() for number in data["episode"].unique()]
    robots, hands = parts[: len(parts) // 2], parts[len(parts) // 2 :]
    read = spoon_reader(torch.cat(robots[max(options.robots) :]))
    done, write = open_table(options.table, COLUMNS, COLUMNS[:3])
    seen = torch.cat(hands)
    for count in options.robots:
        target = [part[:, :EMBEDDING_DIM] for part in robots[:count]]
        alignment = fit_alignment([part[:, :EMBEDDING_DIM] for part in hands], target)
        moved = {
            "not at all": seen[:, :EMBEDDING_DIM],
            "by the means": seen[:, :EMBEDDING_DIM] - seen[:, :EMBEDDING_DIM].mean(0) + torch.cat(target).mean(0),
            "aligned": alignment(seen[:, :EMBEDDING_DIM]),
        }
        for way, embeddings in moved.items():
            if (str(count), str(len(hands)), way) not in done:
                error = (read(embeddings) - seen[:, EMBEDDING_DIM:]).norm(dim=-1).mean()
                same = same_start(hands, [robots[partner] for partner in alignment.partners])
                write((count, len(hands), way, f"{1e3 * float(error):.1f}", same if way == "aligned" else ""))


def same_start(hands: Sequence[Tensor], partners: Sequence[Tensor]) -> int:
    """How many demonstrations begin where their partner does."""
    places = ((part[0, EMBEDDING_DIM:] - other[0, EMBEDDING_DIM:]) for part, other in zip(hands, partners, strict=True))
    return sum(bool(place.norm() < NEAR) for place in places)


def spoon_reader(seen: Tensor) -> Callable[[Tensor], Tensor]:
    """The linear map from embeddings to the spoon's position that fits these frames best."""
    design = torch.cat([seen[:, :EMBEDDING_DIM], torch.ones(len(seen), 1).double()], 1)
    penalty = 1e-3 * torch.eye(design.shape[1]).double()
    weight = torch.linalg.solve(design.T @ design + penalty, design.T @ seen[:, EMBEDDING_DIM:])
    return lambda embeddings: embeddings @ weight[:-1] + weight[-1]


if __name__ == "__main__":
    main()
