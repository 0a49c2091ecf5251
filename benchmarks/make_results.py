# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes docs/results/*.md, the results of the README and the plot of success and entropy from committed figures.

    python benchmarks/make_results.py           # write
    python benchmarks/make_results.py --check   # compare with what is committed, exit 1 if it differs

Figures are in ``benchmarks/results/*.csv``; the text of each page is a template beside them and holds no number.
Intervals are computed from n and successes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from bench_rows import (
    bench_cost,
    bench_default_mean,
    bench_defaults,
    bench_entropy,
    bench_means,
    bench_sentence,
    bench_share,
    bench_size,
    bench_table,
    draw_bench_average,
    first_successes,
    longer_table,
    noise_share,
    observation_table,
    paper_levels_table,
    paper_size,
    plan_error,
    posture_table,
    protocol_cost,
    worst_action,
)
from fault_rows import kill_rows, ledger_rows, raw_rows, resume_rows, soak_rows, version_rows
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from planner_rows import (
    PLANNERS,
    amounts,
    decoded_sizes,
    directions_table,
    disturbances,
    draw_amounts,
    gains,
    planner_options,
    planner_table,
    planner_variants,
    pooled_boxes,
    same_planner_table,
    stuck_table,
)
from readme_pictures import draw_label_curves, draw_pipeline
from result_rows import (
    SOURCE,
    ablation_rows,
    count_rows,
    difference,
    env_rows,
    error_rows,
    export_rows,
    fact,
    first,
    label_sizes,
    left_out_rows,
    level_rows,
    own_robot_rows,
    percent,
    pivot,
    pooled,
    precision_rows,
    preset_rows,
    read_rows,
    rows_if_measured,
    share,
    success,
    suggestion_rows,
    table,
    tracking_rows,
    training_rows,
    window_rows,
)
from scooping_rows import (
    scooping_alignment_table,
    scooping_cell,
    scooping_cost_table,
    scooping_minutes,
    scooping_outlines,
    scooping_parts_table,
    scooping_plans_table,
    scooping_probe_errors,
    scooping_probe_table,
    scooping_start,
    scooping_strokes_table,
    scooping_table,
)
from unlabelled_picture import REGIMES, draw_unlabelled
from unlabelled_rows import (
    followed,
    followed_beside,
    followed_rows,
    unlabelled_cells,
    unlabelled_gains,
    unlabelled_labels,
    unlabelled_missing,
    unlabelled_rows,
    unlabelled_successes,
)

from torchrl_koap.evaluation.statistics import wilson_interval

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- results: made by benchmarks/make_results.py -->", "<!-- end of results -->"
PICTURES = Path("docs") / "pictures"
DRAWN = ("koap", "koap_untrained", "linear_steps", "linear", "dd_lookahead", "dd", "dp")


_TABLES = (
    count_rows,
    window_rows,
    error_rows,
    suggestion_rows,
    level_rows,
    env_rows,
    training_rows,
    precision_rows,
    left_out_rows,
    ablation_rows,
)
_PAPER = (
    paper_levels_table,
    paper_size,
    bench_table,
    bench_default_mean,
    bench_defaults,
    bench_entropy,
    bench_share,
    observation_table,
    bench_sentence,
    bench_size,
    bench_means,
    bench_cost,
    first_successes,
    longer_table,
    noise_share,
    plan_error,
    posture_table,
    protocol_cost,
    worst_action,
)
_UNLABELLED = (
    followed,
    followed_beside,
    followed_rows,
    unlabelled_rows,
    unlabelled_labels,
    unlabelled_gains,
    unlabelled_missing,
)
_FAULTS = (ledger_rows, kill_rows, soak_rows, raw_rows, resume_rows, version_rows)
_SCOOPING = (
    scooping_alignment_table,
    scooping_cell,
    scooping_cost_table,
    scooping_minutes,
    scooping_outlines,
    scooping_parts_table,
    scooping_plans_table,
    scooping_probe_errors,
    scooping_probe_table,
    scooping_start,
    scooping_strokes_table,
    scooping_table,
)
_HELPERS = (
    first,
    label_sizes,
    *_TABLES,
    tracking_rows,
    export_rows,
    preset_rows,
    own_robot_rows,
    *_PAPER,
    *_UNLABELLED,
    *_FAULTS,
    *_SCOOPING,
)


def commands(rows: Sequence[Mapping[str, str]]) -> str:
    """The commands that made some rows, as a block of code."""
    lines = dict.fromkeys(row["command"] for row in rows if row["command"])
    return "```bash\n" + "\n".join(lines) + "\n```"


def pages() -> dict[Path, str]:
    """Every generated text by its path from the repository's root."""
    environment = Environment(
        loader=FileSystemLoader(SOURCE), undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    helpers = (
        read_rows,
        rows_if_measured,
        percent,
        pooled,
        success,
        share,
        table,
        pivot,
        amounts,
        decoded_sizes,
        directions_table,
        disturbances,
        gains,
        same_planner_table,
        stuck_table,
        planner_options,
        planner_variants,
        pooled_boxes,
        planner_table,
        difference,
        fact,
        commands,
        *_HELPERS,
    )
    environment.globals.update(
        {helper.__name__: helper for helper in helpers} | {"int": int, "float": float, "planner_names": PLANNERS}
    )
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
    drawn.append(draw_bench_average("table_1", ROOT / PICTURES / "paper_average.png"))
    drawn.append(draw_amounts(ROOT / PICTURES / "demonstrations.png"))
    tables = ({regime: cells(regime) for regime in REGIMES} for cells in (unlabelled_cells, unlabelled_successes))
    drawn.append(draw_unlabelled(*tables, ROOT / PICTURES))
    print("\n".join(f"wrote {path}" for path in [*stale, *(path.relative_to(ROOT) for path in drawn)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
