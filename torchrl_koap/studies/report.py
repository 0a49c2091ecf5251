# This source code is licensed under the MIT license found in the LICENSE file.
"""The report of a study: table, paired comparisons, pictures and a page that explains them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.data.label_budget import plural_of
from torchrl_koap.files import replacing_file
from torchrl_koap.reports.html import write_page
from torchrl_koap.reports.pictures import FOLDER
from torchrl_koap.runs.run_directory import write_csv
from torchrl_koap.studies.paired_comparison import COMPARISON_COLUMNS, REFERENCE, Outcome, compare_cells
from torchrl_koap.studies.paper import paper_points, write_paper_layout
from torchrl_koap.studies.plots import plot_measure
from torchrl_koap.studies.table import (
    Summary,
    error_units,
    markdown_table,
    not_done,
    percent,
    summarise,
    table_rows,
)
from torchrl_koap.training.methods import METHODS

_JUDGED_ON = " Each share of labels is judged on other recordings: compare methods at one share, not shares of labels."
_CAPTIONS = {
    "success": (
        "Success against the labels",
        "Left against the labelled share, right against the number of distinct transitions whose action was read: a"
        " label on a window or a trajectory is many actions, and overlapping windows share them. Bands (whiskers where"
        " there are many methods, drawn next to each other) are 95 % Wilson intervals over all rollouts of all"
        " seeds.",
    ),
    "mode_entropy": (
        "Modes against the labels",
        "Entropy of the modes of successful rollouts, 1 if all are equally frequent: mean over seeds with a success,"
        " with the best and the worst seed. It is unreliable with few successes. If episodes start alike, replaying"
        " one demonstration can succeed; then the entropy is 0.",
    ),
    "action_error": (
        "Action error against the labels",
        "Mean over seeds, with the best and the worst seed, of the error on recorded actions without labels. They"
        " were read for this picture only; nothing was trained or selected with them. A smaller error need not mean"
        " more success: the planner has its own failures." + _JUDGED_ON,
    ),
    "relative_action_error": (
        "Action error against the labels",
        "Mean over seeds, with the best and the worst seed. There is no environment, so actions decoded from recorded"
        " states are compared with recorded ones: on hidden labels if the data have some (read for this only), else on"
        " seen labels, leaving out one labelled trajectory at a time. 1 (dashed): no better than always giving the"
        " mean action. Columns of every unit count alike." + _JUDGED_ON,
    ),
    "demonstrations": (
        "Success against the demonstrations used",
        "How much demonstrations without labels improve success: the same share of labels, but only part of all"
        " demonstrations used.",
    ),
}


def write_study_report(
    folder: str | Path,
    rows: Sequence[Mapping[str, Any]],
    outcomes: Mapping[str, Outcome] | None = None,
    *,
    title: str,
    options: Mapping[str, Any] | None = None,
) -> Path:
    """Writes ``table.md``, ``comparisons.csv``, pictures and ``index.html`` into the folder of a study.

    If windows are labelled, as in the paper, its figures are shown next to the measured ones.

    Rows are cells of :data:`~torchrl_koap.studies.table.CELL_COLUMNS`, outcomes those of
    :func:`~torchrl_koap.studies.paired_comparison.compare_cells`; the page shows the options of the study.
    """
    folder, summaries = Path(folder), summarise(rows)
    compared = compare_cells(rows, outcomes or {})
    with replacing_file(folder / "table.md") as aside:
        aside.write_text(markdown_table(rows), encoding="utf-8")
    write_csv(folder / "comparisons.csv", COMPARISON_COLUMNS, compared)
    windows = [row for row in rows if row["label_unit"] == "window"]
    offline = {item.task for item in summaries if item.offline}
    return write_page(
        "curve.html",
        folder / "index.html",
        title=title,
        subtitle=str(folder),
        notes=[],
        **_what_was_run(rows),
        options=options or {},
        table=table_rows(summaries),
        layout=write_paper_layout(folder, windows) if windows else None,
        offline=bool(offline),
        rolled_out=not offline or offline != {item.task for item in summaries},
        figures=_draw(folder, summaries, list(dict.fromkeys(row["method"] for row in rows))),
        compared=_comparison_rows(compared, offline),
        reference=REFERENCE,
        not_done=not_done(rows),
    )


def _what_was_run(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns two sentences on the cells, and the titles of their methods."""
    count = Counter(row["status"] for row in rows)
    names = {name: list(dict.fromkeys(row[name] for row in rows)) for name in ("task", "method", "seed")}
    unit = list(dict.fromkeys(plural_of(row["label_unit"]) for row in rows))
    text = ", ".join(
        (
            f"{', '.join(names['task'])}: methods {', '.join(names['method'])}",
            f"labels on {', '.join(percent(share) for share in sorted({row['labels'] for row in rows}))} of the"
            f" {' / '.join(unit)}",
            f"training seeds {', '.join(map(str, sorted(names['seed'])))}",
        )
    )
    done = f"Of {len(rows)} cells {count['done']} are done; failed: {count['failed']}, missing: {count['missing']}."
    known = [{"method": name, "what it is": METHODS[name].title} for name in names["method"] if name in METHODS]
    return {"run_sentence": f"{text}.", "done_sentence": done, "methods": known}


def _draw(folder: Path, summaries: Sequence[Summary], methods: Sequence[str]) -> list[dict[str, Any]]:
    """Draws the pictures of every task; returns what the page needs to show them."""
    figures = []
    for task in dict.fromkeys(item.task for item in summaries):
        items = [item for item in summaries if item.task == task]
        shares = sorted({item.demonstrations for item in items})
        main = [item for item in items if item.demonstrations == shares[-1]]
        points = paper_points(task) if items[0].label_unit == "window" else {}
        points = {item.method: points[item.method] for item in items if item.method in points}
        error = "relative_action_error" if any(item.mean("relative_action_error") for item in main) else "action_error"
        wanted: dict[str, dict[str, Any]] = {
            "success": {"by": ("labels", "labelled_transitions"), "paper": points},
            "mode_entropy": {},
            error: {"unit": error_units(main) if error == "action_error" else ""},
        }
        known = [kind for kind in wanted if any(kind in item.measures for item in main)]
        if error in known and min(item.measures[error].low for item in main if error in item.measures) <= 0:
            known.remove(error)
        used = f" All with {percent(shares[-1])} of the demonstrations." if shares[-1] != 1 else ""
        hollow = " Hollow, dashed: the paper, for its own demonstrations and planner." if points else ""
        for kind in known:
            options = {"methods": methods, "label_unit": plural_of(items[0].label_unit), **wanted[kind]}
            more = used + hollow if kind == "success" else ""
            figures.append(_figure(folder, kind, main, more, **options))
        if len(shares) > 1 and "success" in known:
            figures.append(_figure(folder, "demonstrations", items, by=("demonstrations",), methods=methods))
    return figures


def _figure(folder: Path, kind: str, items: Sequence[Summary], more: str = "", **options: Any) -> dict[str, Any]:
    """Draws a picture of a task; returns what the page needs to show it."""
    source, (head, caption) = f"{FOLDER}/{items[0].task}_{kind}.png", _CAPTIONS[kind]
    plot_measure(items, folder / source, "success" if kind == "demonstrations" else kind, **options)
    wide = kind == "success"  # two panels need the width of the page
    return {"title": f"{head}, {items[0].task}", "caption": caption + more, "source": source, "beside": not wide}


def _comparison_rows(compared: Sequence[Mapping[str, Any]], offline: Collection[str]) -> list[dict[str, str]]:
    """Returns the comparisons as text: of errors for ``offline`` tasks, else of success, in points."""
    rows = [_comparison_row(row, errors=row["task"] in offline) for row in compared]
    alike = [name for name in ("task", "demonstrations used") if len({row[name] for row in rows}) == 1]
    return [{name: text for name, text in row.items() if name not in alike} for row in rows]


def _comparison_row(row: Mapping[str, Any], *, errors: bool) -> dict[str, str]:
    factor, digits, head, unit = 100, 1, "difference (points)", "contexts"
    if errors:
        factor, digits, head, unit = 1, 3, "difference of the relative action error", "trajectories"

    def text(difference: float) -> str:
        return f"{round(factor * difference, digits) + 0.0:+.{digits}f}"  # the sum turns -0.0 into 0.0

    return {
        "task": row["task"],
        "demonstrations used": percent(row["demonstrations"]),
        "labels": percent(row["labels"]),
        f"{REFERENCE} against": row["method"],
        head: "no common rollouts" if row["difference"] is None else text(row["difference"]),
        "95 % interval": "–" if row["low"] is None else f"{text(row['low'])} to {text(row['high'])}",
        "p": _p_text(row["p"]),
        "p (Holm)": _p_text(row["p_holm"]),
        unit: str(row["contexts"] or 0),
        "seeds": str(row["seeds"] or 0),
        "n (pairs)": str(row["n"]),
    }


def _p_text(p: float | None) -> str:
    return "–" if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"
