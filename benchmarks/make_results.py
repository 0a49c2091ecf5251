# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes docs/results/*.md, the results of the README and the plot of success and entropy from committed figures.

    python benchmarks/make_results.py           # write
    python benchmarks/make_results.py --check   # compare with what is committed, exit 1 if it differs

Figures are in ``benchmarks/results/*.csv``; the text of each page is a template beside them and holds no number.
Intervals are computed from n and successes.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from readme_pictures import draw_label_curves, draw_pipeline
from scipy.stats import t as student
from unlabelled_picture import REGIMES, draw_errors

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.studies.paper_layout import above_the_paper, as_markdown, layout_rows, paper_entries
from torchrl_koap.studies.paper_results import paper_cells, paper_levels, paper_points
from torchrl_koap.studies.paper_tables import PAPER_TASKS
from torchrl_koap.studies.table import read_cells

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "benchmarks" / "results"
CELLS = SOURCE / "cells"  # of whole comparisons, as `koap bench` writes them
BEGIN, END = "<!-- results: made by benchmarks/make_results.py -->", "<!-- end of results -->"
PICTURES = Path("docs") / "pictures"
DRAWN = ("koap", "koap_untrained", "linear_steps", "linear", "dd_lookahead", "dd", "dp")


def read_rows(name: str, **wanted: Any) -> list[dict[str, str]]:
    """Rows of a CSV file whose columns have the wanted values.

    Args:
        name (str): file without its ending.
        **wanted: column to value; numbers are compared as numbers.

    Raises:
        KeyError: if a column is not in the file.
    """
    with (SOURCE / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, strict=True))
    return [row for row in rows if all(_same(row[column], value) for column, value in wanted.items())]


def _same(text: str, value: Any) -> bool:
    return text == value if isinstance(value, str) else bool(text) and float(text) == value


def percent(row: Mapping[str, str], digits: int = 1) -> str:
    """Success of a row in percent with its Wilson interval."""
    successes, trials = int(row["successes"]), int(row["n"])
    low, high = (100 * end for end in wilson_interval(successes, trials))
    return f"{100 * successes / trials:.{digits}f} % ({low:.{digits}f}-{high:.{digits}f})"


def success(row: Mapping[str, str]) -> str:
    """Success of a row in percent, its interval in whole percent, and the entropy."""
    successes, trials = int(row["successes"]), int(row["n"])
    low, high = (100 * end for end in wilson_interval(successes, trials))
    entropy = f", {float(row['entropy']):.2f}" if row.get("entropy") else ""
    return f"{100 * successes / trials:.1f} ({low:.0f}-{high:.0f}){entropy}"


def share(fraction: str | float) -> str:
    """A fraction in percent."""
    return f"{100 * float(fraction):.6g} %"


def table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (head, *body)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def pivot(rows: Sequence[Mapping[str, str]], cell: Any, *, by: str = "label_fraction", head: str = "method") -> str:
    """A table with a row per method and a column per label budget.

    Args:
        rows (sequence of mapping): rows of a file.
        cell (callable): from a row to a text.

    Keyword Args:
        by (str): what the columns are.
        head (str): heading of the first column.
    """
    places = list(dict.fromkeys(row[by] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    found = {(row["method"], row[by]): cell(row) for row in rows}
    body = [[f"`{method}`", *(found.get((method, place), "") for place in places)] for method in methods]
    return table([head, *map(share, places)], body)


def planner_table(rows: Sequence[Mapping[str, str]]) -> str:
    """A row per trained planner and way to run it."""
    head = [
        "labels",
        "method",
        "planner",
        "updates x batch",
        "seed",
        "candidates",
        "success in % (95 %), entropy",
        "steps",
        "",
    ]
    body = [
        [
            row["labels"],
            "*oracle*" if row.get("controller") == "oracle" else f"`{row['method']}`",
            row["denoiser"],
            f"{row['updates']} x {row['batch']}",
            row["training_seed"],
            row["candidates"] if row["candidates"] == "1" else f"{row['candidates']}, {row['choice']}",
            success(row),
            row["mean_steps"],
            row["note"],
        ]
        for row in rows
    ]
    return table(head, body)


def difference(row: Mapping[str, str]) -> str:
    """A difference in percentage points with its interval."""
    return f"{float(row['difference']):+.1f} ({int(row['low']):+d} to {int(row['high']):+d})"


def fact(key: str, form: str = "") -> str:
    """A single figure with its unit.

    Args:
        key (str): its key in ``facts.csv``.
        form (str): ``"count"`` for "k of n", ``"rate"`` for percent with interval, ``"bare"`` for no unit.
    """
    (row,) = read_rows("facts", key=key)
    if form == "rate" or (row["successes"] and not form):
        return percent(row)
    if form == "count":
        return f"{row['successes']} of {row['n']}"
    return row["value"] if form == "bare" or not row["unit"] else f"{row['value']} {row['unit']}"


def first(column: str) -> Any:
    """A cell of a pivot table: a column as it is."""
    return lambda row: row[column]


def label_sizes(study: str) -> list[list[str]]:
    """What every share of the labels of a study is."""
    found = {}
    for row in read_rows("label_curves", study=study):
        numbers = [row["labelled_trajectories"], f"{int(row['labelled_transitions']):,}"]
        found[row["label_fraction"]] = [share(row["label_fraction"]), *numbers]
    return list(found.values())


def spread(row: Mapping[str, str]) -> str:
    """A mean error with its range over seeds."""
    return f"{row['error']} ({row['low']}-{row['high']})"


def to_koap(row: Mapping[str, str]) -> str:
    """A paired difference with its interval, empty where there is none."""
    if not row["difference"]:
        return ""
    return f"{row['difference']} ({row['difference_low']} to {row['difference_high']})"


def count_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the results by number of labelled demonstrations."""
    return [
        [f"{row['demonstrations']} {row['data']}", f"`{row['method']}`", row["labelled_trajectories"], spread(row)]
        + [row["ridge_error"], percent(row), row["entropy"], row["pooled_entropy"]]
        for row in rows
    ]


def window_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the results with labels on windows."""
    return [
        [
            f"{row['demonstrations']} {row['data']}",
            *(", ".join(row[f"{kind}_seed_{n}"] for n in range(3)) for kind in ("error", "ridge")),
            percent(row),
            row["entropy"],
        ]
        for row in rows
    ]


def error_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of action errors."""
    return [
        [row["task"], share(row["label_fraction"]), f"`{row['method']}`", f"{spread(row)} {row['unit']}", to_koap(row)]
        for row in rows
    ]


def suggestion_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the criteria by which demonstrations are labelled."""
    return [
        [row["chosen"], f"`{row['criterion']}`", row["labelled_transitions"], spread(row), to_koap(row)]
        + [row["random_error"]]
        for row in rows
    ]


def level_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of tasks and labels: KOAP, the recurrent network, and the paper's KOAP at the same share."""
    other = {(row["task"], row["label_fraction"]): percent(row) for row in rows if row["method"] == "recurrent"}
    return [
        [row["task"] + (f", {row['goal']}" if row["goal"] else ""), share(row["label_fraction"]), percent(row)]
        + [other.get((row["task"], row["label_fraction"]), "not run"), row["entropy"], paper_at_share(row)]
        for row in rows
        if row["method"] == "koap"
    ]


def paper_at_share(row: Mapping[str, str]) -> str:
    """The paper's KOAP at the share of labels of a row, empty where it has no such level or counts another goal."""
    task = {"stacking": "stacking_1"}.get(row["task"], row["task"])
    if row["goal"] not in ("", "first box"):
        return ""
    points = [point for point in paper_points(task, [float(row["label_fraction"])]) if point["method"] == "koap"]
    return "".join(f"{100 * point['success']:.1f} +- {100 * point['spread']:.1f}" for point in points)


def paper_levels_table() -> str:
    """The shares of labels that are the paper's levels, by task."""
    body = [[f"`{task}`", *map(share, paper_levels(task))] for task in PAPER_TASKS]
    return table(["task", *(f"level {level}" for level in range(1, 6))], body)


def bench_table(name: str) -> str:
    """Cells of a comparison in the layout of the paper's tables, the paper's beside each.

    Args:
        name (str): file of cells without its ending.
    """
    return as_markdown(layout_rows(paper_entries(read_cells(CELLS / f"{name}.csv"))))


def paper_size() -> str:
    """Number of cells that the paper's tables have."""
    return str(sum(cell.task != "stacking_1" for number in (1, 2) for cell in paper_cells(number)))


def bench_sentence(name: str) -> str:
    """In how many cells of a comparison KOAP is above the paper's."""
    above, both = above_the_paper(paper_entries(read_cells(CELLS / f"{name}.csv")))
    return f"{above} of {both}"


def bench_size(name: str) -> str:
    """Seeds, rollouts and unit of the labels of a comparison, as its cells have them."""
    cells = [row for row in read_cells(CELLS / f"{name}.csv") if row["status"] == "done"]
    seeds, episodes, units = ({row[part] for row in cells} for part in ("seed", "episodes", "label_unit"))
    rollouts = " or ".join(map(str, sorted(episodes)))
    plural = "s" if len(seeds) > 1 else ""
    return (
        f"{len(cells)} cells, {len(seeds)} training seed{plural}, {rollouts} rollouts each, {'/'.join(units)}s labelled"
    )


def env_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the environments' speed."""
    return [
        [row["task"], row["batch"], row["threads"], f"{int(row['median']):,}", f"{row['over_original']}x"]
        for row in rows
    ]


def training_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the speed of training and planning."""
    names = ("updates_per_second", "plan_1_ms", "plan_60_ms")
    return [
        [row["part"], row["variant"], f"{int(row['parameters']):,}", *(row[name] for name in names)] for row in rows
    ]


def ablation_rows(topic: str) -> list[list[str]]:
    """Table of the ablations of a topic: successes with their interval, other measures with their unit."""
    return [
        [row["variant"], row["condition"], row["measure"]]
        + [f"{row['successes']}/{row['n']} = {percent(row)}" if row["successes"] else f"{row['value']} {row['unit']}"]
        for row in read_rows("ablations", topic=topic)
    ]


def tracking_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the distances to a perfect plan."""
    names = ("labelled_trajectories", "blend_decay", "step_12", "step_30", "step_48")
    return [[row[name] for name in names] for row in rows]


def export_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the ways to call a whole policy."""
    return [list(row.values()) for row in rows]


def preset_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the presets."""
    return [[row["preset"], row["decoder"], f"{row['action_error']} {row['unit']}"] for row in rows]


def unlabelled_cells(regime: str) -> dict[tuple[str, int], dict[int, float]]:
    """Action errors of a regime by method and number of labelled trajectories, then by seed."""
    found: dict[tuple[str, int], dict[int, float]] = {}
    for row in read_rows("unlabelled_data", regime=regime):
        found.setdefault((row["method"], int(row["labels"])), {})[int(row["seed"])] = float(row["error"])
    return found


def unlabelled_rows(regime: str) -> list[list[str]]:
    """A row per method of a regime: mean error and range over seeds for every number of labelled trajectories."""
    cells = unlabelled_cells(regime)
    labels = sorted({number for _, number in cells})
    body = []
    for method in dict.fromkeys(method for method, _ in cells):
        row = [f"`{method}`"]
        for number in labels:
            errors = list(cells.get((method, number), {}).values())
            ends = f"{min(errors):.2f}-{max(errors):.2f}, {len(errors)} seeds" if errors else ""
            row.append(f"{statistics.fmean(errors):.2f} ({ends})" if errors else "not run")
        body.append(row)
    return body


def unlabelled_labels(regime: str) -> list[str]:
    """Headings of :func:`unlabelled_rows`."""
    return [f"{number} labelled" for number in sorted({number for _, number in unlabelled_cells(regime)})]


def unlabelled_gains(regimes: Sequence[str], against: Sequence[str]) -> list[list[str]]:
    """How much smaller the error of ``semi_supervised`` is, in percent, paired by seed, with a 95 % t-interval."""
    body = []
    for regime in regimes:
        cells = unlabelled_cells(regime)
        for number in sorted({number for _, number in cells}):
            row = [REGIMES[regime], str(number)]
            for method in against:
                own, other = (cells.get((name, number), {}) for name in ("semi_supervised", method))
                row.append(paired_gain([100 * (1 - own[seed] / other[seed]) for seed in own.keys() & other.keys()]))
            body.append(row)
    return body


def paired_gain(gains: Sequence[float]) -> str:
    """Mean of some gains in percent with its 95 % t-interval; no interval below three."""
    if len(gains) < 3:
        return f"{statistics.fmean(gains):+.0f} % ({len(gains)} seeds)" if gains else "not run"
    half = student.ppf(0.975, len(gains) - 1) * statistics.stdev(gains) / len(gains) ** 0.5
    mean = statistics.fmean(gains)
    return f"{mean:+.0f} % ({mean - half:+.0f} to {mean + half:+.0f})"


_TABLES = (count_rows, window_rows, error_rows, suggestion_rows, level_rows, env_rows, training_rows, ablation_rows)
_PAPER = (paper_levels_table, paper_size, bench_table, bench_sentence, bench_size)
_UNLABELLED = (unlabelled_rows, unlabelled_labels, unlabelled_gains)
_HELPERS = (first, label_sizes, *_TABLES, tracking_rows, export_rows, preset_rows, *_PAPER, *_UNLABELLED)


def commands(rows: Sequence[Mapping[str, str]]) -> str:
    """The commands that made some rows, as a block of code."""
    lines = dict.fromkeys(row["command"] for row in rows if row["command"])
    return "```bash\n" + "\n".join(lines) + "\n```"


def pages() -> dict[Path, str]:
    """Every generated text by its path from the repository's root."""
    environment = Environment(
        loader=FileSystemLoader(SOURCE), undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    helpers = (read_rows, percent, success, share, table, pivot, planner_table, difference, fact, commands, *_HELPERS)
    environment.globals.update({helper.__name__: helper for helper in helpers} | {"int": int, "float": float})
    made = {}
    for template in sorted(SOURCE.glob("*.md.jinja")):
        name = template.name.removesuffix(".jinja")
        text = environment.get_template(template.name).render()
        if name == "readme.md":
            whole = (ROOT / "README.md").read_text(encoding="utf-8")
            before, rest = whole.split(BEGIN)
            made[Path("README.md")] = f"{before}{BEGIN}\n{text.strip()}\n{END}{rest.split(END)[1]}"
        else:
            made[Path("docs") / "results" / name] = text
    return made


def curves() -> dict[str, list[dict[str, float]]]:
    """Success, entropy and their intervals against the labels, by method, of the methods that are drawn."""
    lines: dict[str, list[dict[str, float]]] = {}
    for row in read_rows("label_curves", study="avoiding"):
        if row["method"] in DRAWN:
            low, high = wilson_interval(int(row["successes"]), int(row["n"]))
            point = {"fraction": float(row["label_fraction"]), "entropy": float(row["entropy"])} | {
                "low": low,
                "high": high,
            }
            lines.setdefault(row["method"], []).append(point | {"success": int(row["successes"]) / int(row["n"])})
    return {method: lines[method] for method in DRAWN}


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes or compares every page; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, compare with what is there")
    options = parser.parse_args(arguments)
    stale = []
    for path, text in pages().items():
        there = (ROOT / path).read_text(encoding="utf-8") if (ROOT / path).exists() else None
        if there != text:
            stale.append(path)
            if not options.check:
                (ROOT / path).parent.mkdir(parents=True, exist_ok=True)
                (ROOT / path).write_text(text, encoding="utf-8")
    if options.check:
        print("\n".join(f"{path} is not what the figures give" for path in stale) or "every page is up to date")
        return int(bool(stale))
    (ROOT / PICTURES).mkdir(parents=True, exist_ok=True)
    drawn = [draw_label_curves(curves(), ROOT / PICTURES / "success_and_entropy.png")]
    drawn += [draw_pipeline(ROOT / PICTURES / f"pipeline.{kind}") for kind in ("svg", "png")]
    drawn.append(draw_errors({regime: unlabelled_cells(regime) for regime in REGIMES}, ROOT / PICTURES))
    print("\n".join(f"wrote {path}" for path in [*stale, *(path.relative_to(ROOT) for path in drawn)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
