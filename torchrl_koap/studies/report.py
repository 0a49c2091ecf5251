# This source code is licensed under the MIT license found in the LICENSE file.
"""The report of a label-efficiency curve: table, paired comparisons, pictures and a page that explains them."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from torchrl_koap.files import replacing_file
from torchrl_koap.reports.html import STYLE, definition, duration, table
from torchrl_koap.studies.paired_comparison import COMPARISON_COLUMNS, compare_cells, p_text
from torchrl_koap.studies.plots import plot_action_error, plot_entropy, plot_success
from torchrl_koap.studies.summary import Summary, cell_name, percent, plural, summarise
from torchrl_koap.studies.table import markdown_table, table_rows, why_not_done
from torchrl_koap.tasks import get_task
from torchrl_koap.training.methods import METHODS
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

FOLDER = "plots"
_STYLE = ".scroll td { white-space: nowrap; }\n"  # an interval on two lines cannot be read down the column
_CAPTIONS = {
    "success": (
        "Success against the labels",
        "Left against the labelled share, right against the number of distinct transitions whose action was read: a"
        " label on a window or a trajectory is many actions, and overlapping windows share them. Bands (whiskers where"
        " there are many methods, drawn a little beside each other) are 95 % Wilson intervals over all rollouts of all"
        " seeds.",
    ),
    "entropy": (
        "Modes against the labels",
        "Entropy of the modes of successful rollouts, 1 if all are equally frequent: mean over seeds, with the best and"
        " the worst seed. Success alone can be had by playing one demonstration again, wherever episodes start alike;"
        " then the entropy is 0.",
    ),
    "action_error": (
        "Action error against the labels",
        "Mean over seeds, with the best and the worst seed, of the error on recorded actions outside the budget. They"
        " were read for this picture only; nothing was trained or selected with them. A smaller error need not mean"
        " more success: the planner has its own failures.",
    ),
    "observations": (
        "Success against the trajectories used",
        "How much the trajectories without labels are worth: the same share of labels, but only part of all"
        " trajectories known at all.",
    ),
}
_READING = """
<p>A <strong>cell</strong> is one method, trained with one seed on one budget of labels, then rolled out on fixed
evaluation contexts. The table pools the seeds.</p>
<ul>
<li><strong>Success (95 %)</strong> is a Wilson interval over all rollouts. It takes them for independent; the same
contexts recur for every seed, so where single seeds lie further apart than chance allows it is too narrow. That is why
the range of the seeds stands beside it.</li>
<li><strong>Paired comparisons</strong> use that all methods met the same contexts with the same evaluation seeds. The
difference is averaged over training seeds within each context, then over contexts. Its interval resamples contexts and
training seeds both: a few seeds say little about the next training, and the interval is as wide as that. With a single
seed it holds for that one training only.</li>
<li><strong>p</strong> flips signs per context: could the advantage of these trained networks be chance of the contexts?
It does not cover other training seeds: where those matter it is below 0.05 far too often, and the interval is what to
go by. Where episodes have no contexts (Avoiding) a pair shares its evaluation seed alone, and pairing gains little.
<strong>p (Holm)</strong> is corrected for the number of comparisons on this page.</li>
<li><strong>One planner</strong> is shared by all cells that plan, for each task and share of the trajectories. The
seeds vary the controller and which labels it sees; how much another planner would change is in no interval here.</li>
<li>Cells that <strong>failed or are missing</strong> are in no average. They are counted and named; if hard cells fail
more often, the averages of the others flatter the method.</li>
</ul>
"""


def write_curve_report(
    folder: str | Path,
    rows: Sequence[Mapping[str, Any]],
    *,
    title: str,
    paper: Sequence[Mapping[str, Any]] | None = None,
    reference: str = "koap",
) -> Path:
    """Writes ``table.md``, ``comparisons.csv``, pictures and ``index.html`` into the folder of a curve.

    Args:
        folder (str or Path): the curve's folder; made if it is not there. Read are ``curve.json`` (the options) and
            every done cell's ``eval.json``, all optional: the page says what is absent or damaged.
        rows (sequence of mapping): cells, see :data:`~torchrl_koap.studies.table.CELL_COLUMNS`.

    Keyword Args:
        title (str): heading of the page.
        paper (sequence of mapping, optional): the paper's figures as of
            :func:`~torchrl_koap.studies.paper_results.paper_points`: ``task``, ``method``, ``fraction``, ``success``
            in 0..1.
        reference (str): the method that all others are compared with.

    Returns:
        Path: the page.

    Raises:
        ValueError: if a cell occurs twice, or is done without its number of episodes and successes.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.studies.report import write_curve_report
        >>> cell = {"task": "avoiding", "method": "koap", "fraction": 0.02, "seed": 0, "status": "missing"}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     "failed: 0, missing: 1" in write_curve_report(folder, [cell], title="a curve").read_text()
        True
    """
    folder = Path(folder)
    summaries = summarise(rows)
    compared, problems = compare_cells(folder, rows, reference=reference)
    options, notes = _options(folder)
    problems = notes + problems
    with replacing_file(folder / "table.md") as aside:
        aside.write_text(markdown_table(rows), encoding="utf-8")
    with replacing_file(folder / "comparisons.csv") as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COMPARISON_COLUMNS)
        writer.writeheader()
        writer.writerows(compared)
    figures = _draw(folder, summaries, list(dict.fromkeys(row["method"] for row in rows)), paper or ())
    sections = [
        f"<header><h1>{escape(title)}</h1><p>{escape(str(folder))}</p></header>",
        "".join(f'<p class="warning">{escape(problem)}</p>' for problem in problems),
        _what_was_run(rows, options),
        _section("Success", _wide(table_rows(summaries)) + _paper_table(summaries, paper or ())),
        _section("Pictures", figures),
        _section("Paired comparisons", _comparisons(compared, reference)),
        _not_done(rows),
        _section("How to read this", _READING),
        _section("Time", _time(rows)),
    ]
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{STYLE}{_STYLE}</style></head>\n'
        f"<body><main>\n{chr(10).join(section for section in sections if section)}\n</main></body></html>\n"
    )
    path = folder / "index.html"
    with replacing_file(path) as aside:
        aside.write_text(page, encoding="utf-8")
    return path


def _options(folder: Path) -> tuple[dict[str, Any], list[str]]:
    if not (folder / "curve.json").exists():
        return {}, []
    try:
        return RunDirectory(folder).read_json("curve.json"), []
    except (RunDirectoryError, OSError) as error:
        return {}, [str(error)]


def _section(head: str, body: str) -> str:
    return f"<section><h2>{escape(head)}</h2>{body}</section>" if body else ""


def _wide(rows: Sequence[Mapping[str, str]]) -> str:
    """A table of texts; an empty one says so."""
    return definition("", list(rows)) if rows else "<p>No cells.</p>"


def _what_was_run(rows: Sequence[Mapping[str, Any]], options: Mapping[str, Any]) -> str:
    count = {status: sum(row["status"] == status for row in rows) for status in ("done", "failed", "missing")}
    names = {name: list(dict.fromkeys(row.get(name) for row in rows)) for name in ("task", "method", "seed")}
    unit = list(dict.fromkeys(plural(row.get("label_unit") or "") for row in rows))
    text = ", ".join(
        (
            f"{', '.join(map(str, names['task']))}: methods {', '.join(map(str, names['method']))}",
            f"labels on {', '.join(percent(share) for share in sorted({row['fraction'] for row in rows}))} of the"
            f" {' / '.join(unit)}",
            f"training seeds {', '.join(map(str, sorted(names['seed'])))}",
        )
    )
    done = f"Of {len(rows)} cells {count['done']} are done; failed: {count['failed']}, missing: {count['missing']}."
    every = f"<details><summary>Every option</summary>{table(options)}</details>" if options else ""
    known = [{"method": name, "what it is": METHODS[name].title} for name in names["method"] if name in METHODS]
    what = definition("", known) if known else ""
    return _section("What was run", f"<p>{escape(text)}.</p><p>{escape(done)}</p>{what}{every}")


def _draw(
    folder: Path, summaries: Sequence[Summary], methods: Sequence[str], paper: Sequence[Mapping[str, Any]]
) -> str:
    """Draws the pictures of every task and unit of the labels; markup that shows them."""
    groups = list(dict.fromkeys((item.task, item.label_unit) for item in summaries))
    text = ""
    for task, unit in groups:
        items = [item for item in summaries if (item.task, item.label_unit) == (task, unit)]
        shares = sorted({item.observations for item in items})
        main = [item for item in items if item.observations == shares[-1]]
        name = task if sum(task == other for other, _ in groups) == 1 else f"{task}_{unit}"
        base, common = folder / FOLDER, {"methods": methods, "label": plural(unit) if unit else ""}
        points = [row for row in paper if row.get("task", task) == task]
        if any(item.success is not None for item in main):
            plot_success(main, base / f"{name}_success.png", paper=points, **common)
            for by, what in (("fraction", "labels"), ("labelled_transitions", "transitions")):
                if any(getattr(item, by) is not None and item.episodes for item in main):
                    plot_success(main, base / f"{name}_success_{what}.png", by=[by], paper=points, **common)
            used = f" All with {percent(shares[-1])} of the trajectories." if shares[-1] != 1 else ""
            hollow = " Hollow, dashed: the paper, for its own demonstrations and planner." if points else ""
            text += _figure(name, "success", task, used + hollow)
        if any(item.entropy is not None for item in main):
            plot_entropy(main, base / f"{name}_entropy.png", **common)
            text += _figure(name, "entropy", task, "")
        if any((item.action_error_low or 0) > 0 for item in main):
            plot_action_error(main, base / f"{name}_action_error.png", unit=_error_unit(task), **common)
            text += _figure(name, "action_error", task, "")
        if len(shares) > 1 and any(item.success is not None for item in items):
            plot_success(items, base / f"{name}_observations.png", by=["observations"], **common)
            text += _figure(name, "observations", task, "")
    return text or "<p>Nothing to draw: no cell is done.</p>"


def _error_unit(task: str) -> str:
    try:
        return {"m": "mm", "rad": "mrad"}.get(get_task(task).action_unit, get_task(task).action_unit)
    except ValueError:
        return ""


def _figure(name: str, kind: str, task: str, more: str) -> str:
    head, caption = _CAPTIONS[kind]
    source = escape(f"{FOLDER}/{name}_{kind}.png")
    head = escape(f"{head}, {task}")
    image = f'<a href="{source}"><img src="{source}" alt="{head}"></a>'
    text = escape(caption + more)
    if kind == "success":  # two panels need the width of the page
        return f"<figure><h3>{head}</h3>{image}<figcaption>{text}</figcaption></figure>"
    return f'<figure class="beside">{image}<figcaption><h3>{head}</h3>{text}</figcaption></figure>'


def _paper_table(summaries: Sequence[Summary], paper: Sequence[Mapping[str, Any]]) -> str:
    if not paper:
        return ""
    ours = {(item.task, item.method, item.fraction): item for item in summaries if item.success is not None}
    rows = []
    for row in paper:
        item = ours.get((row["task"], row["method"], row["fraction"])) if "task" in row else None
        here = "not run" if item is None else f"{percent(item.success, 1)} ({100 * item.low:.1f}-{100 * item.high:.1f})"
        names = {"task": row.get("task", ""), "method": row["method"], "labels": percent(row["fraction"])}
        rows.append(names | {"paper": percent(row["success"], 0), "here (95 %)": here})
    return (
        "<h3>Beside the paper's figures</h3>" + _wide(rows) + '<p class="absent">The paper\'s figures are for its own'
        " demonstrations, planner and number of rollouts: no like-for-like comparison. What is not listed is not known"
        " to this package.</p>"
    )


def _comparisons(compared: Sequence[Mapping[str, Any]], reference: str) -> str:
    if not compared:
        return f"<p>No other method beside {escape(reference)} to compare with, or {escape(reference)} was not run.</p>"
    rows = []
    for row in compared:
        known = row["difference"] is not None
        names = {"task": row["task"]} if len({other["task"] for other in compared}) > 1 else {}
        if len({other["observations"] for other in compared}) > 1:
            names["trajectories used"] = percent(row["observations"])
        rows.append(
            names
            | {
                "labels": percent(row["fraction"]),
                f"{reference} against": row["method"],
                "difference (points)": _points(row["difference"]) if known else "nothing in common",
                "95 % interval": f"{_points(row['low'])} to {_points(row['high'])}" if known else "–",
                "p": p_text(row["p"]),
                "p (Holm)": p_text(row["p_holm"]),
                "contexts": str(row["contexts"] or 0),
                "seeds": str(row["seeds"] or 0),
                "n (pairs)": str(row["n"]),
            }
        )
    text = f"<p>Above 0: {escape(reference)} succeeds more often. Also in <code>comparisons.csv</code>.</p>"
    return text + _wide(rows)


def _points(difference: float) -> str:
    return f"{round(100 * difference, 1) + 0.0:+.1f}"  # the sum turns -0.0 into 0.0


def _not_done(rows: Sequence[Mapping[str, Any]]) -> str:
    items = [row for row in rows if row["status"] != "done"]
    lines = [f"<li>{escape(cell_name(row))}: {escape(why_not_done(row))}</li>" for row in items]
    return _section("Failed and missing cells", f"<ul>{''.join(lines)}</ul>" if lines else "")


def _time(rows: Sequence[Mapping[str, Any]]) -> str:
    done = [row for row in rows if row["status"] == "done"]
    spent_by, total = [], 0.0
    for task, method in dict.fromkeys((row["task"], row["method"]) for row in done):
        cells = [row for row in done if (row["task"], row["method"]) == (task, method)]
        spent = {"task": task, "method": method, "cells": str(len(cells))}
        for name, head in (("train_seconds", "training per cell"), ("eval_seconds", "evaluation per cell")):
            values = [row[name] for row in cells if row.get(name) is not None]
            total += sum(values)
            worst = f", at most {duration(max(values))}" if len(values) > 1 else ""
            spent[head] = f"{duration(statistics.fmean(values))}{worst}" if values else "–"
        spent_by.append(spent)
    names = ("method", "labels", "seed", "status", "success", "training", "evaluation", "run")
    every = [dict(zip(names, _cell(row), strict=True)) for row in rows]
    if not spent_by:
        return ""
    text = (
        f"<p>All cells together: {duration(total)} as they report it; a planner is trained once for all that plan.</p>"
    )
    return text + _wide(spent_by) + f"<details><summary>Every cell</summary>{_wide(every)}</details>"


def _cell(row: Mapping[str, Any]) -> list[str]:
    good, episodes = row.get("successes"), row.get("episodes")
    times = [row.get("train_seconds"), row.get("eval_seconds")]
    return [
        str(row["method"]),
        percent(row["fraction"]),
        str(row["seed"]),
        row["status"],
        f"{good} of {episodes}" if episodes else "–",
        *("–" if value is None else duration(value) for value in times),
        row.get("run") or "–",
    ]
