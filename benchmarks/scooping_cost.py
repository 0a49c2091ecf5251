# This source code is licensed under the MIT license found in the LICENSE file.
"""What a cell of Scooping cost in wall time, added up from what its folders hold; nothing is run or timed.

    python benchmarks/scooping_cost.py --folder runs/scooping --run koap_both_20_0

Training notes its seconds itself. Recording, embedding and rolling out do not: theirs are spans between the times at
which their files were written, and count whatever else the machine did meanwhile. The rollouts of ``--run`` must have
been made right after its training, as ``benchmarks/scooping.py`` makes them the first time.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterable
from pathlib import Path

from torchrl_koap.tasks.scooping import EMBODIMENTS

TABLE = Path(__file__).parent / "results" / "scooping_cost.csv"
COLUMNS = ("part", "what", "seconds", "source")


def span(files: Iterable[Path]) -> tuple[float, int]:
    """Seconds in which files were written one after the other, and how many there are.

    The first one took as long as the others did on average: when it was begun is not known.

    Args:
        files (iterable of Path): at least two.

    Raises:
        ValueError: for fewer.
    """
    times = sorted(path.stat().st_mtime for path in files)
    if len(times) < 2:
        raise ValueError(f"a span needs at least two files, got {len(times)}")
    return (times[-1] - times[0]) * len(times) / (len(times) - 1), len(times)


def cost_rows(folder: Path, run: str, planner: str) -> list[dict[str, str]]:
    """A row per part of a cell.

    Args:
        folder (Path): of ``benchmarks/scooping.py``.
        run (str): the cell's folder in it.
        planner (str): the folder in it of the planner that the cell shares with others.

    Raises:
        FileNotFoundError: if one of them was not finished.
    """
    rows, files = [], "times of files"
    for who in EMBODIMENTS:
        seconds, count = span((folder / who / "data").rglob("*.parquet"))
        rows.append(("record", f"{who}, {count} demonstrations", seconds, files))
    seconds, count = span((folder / "cache").glob("*.safetensors"))
    rows.append(("embed", f"{count} demonstrations, once", seconds, files))
    trained = {
        name: json.loads((folder / name / "summary.json").read_text())["train_seconds"] for name in (planner, run)
    }
    rows.append(("planner", "shared by all methods", trained[planner]["planner"], "summary.json"))
    rows.append(("controller", run, trained[run]["controller"], "summary.json"))
    result = json.loads((folder / run / "eval.json").read_text())
    began, ended = (folder / run / "digests.json").stat().st_mtime, (folder / run / "eval.json").stat().st_mtime
    rows.append(("roll out", f"{result['episodes']} rollouts", ended - began, files))
    return [dict(zip(COLUMNS, (*row[:2], f"{row[2]:.0f}", row[3]), strict=True)) for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True, help="of benchmarks/scooping.py")
    parser.add_argument("--run", required=True, help="the cell, a folder in it")
    parser.add_argument("--planner", default="planner_both_0", help="its planner, a folder in it")
    options = parser.parse_args()
    rows = cost_rows(options.folder, options.run, options.planner)
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(TABLE.read_text())


if __name__ == "__main__":
    main()
