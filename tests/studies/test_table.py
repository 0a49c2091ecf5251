# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests cells as a file, pooled and as a table: complete rows, types, errors of damage."""

import pytest
from tiny_runs import read_csv

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.runs.run_directory import write_csv
from torchrl_koap.studies.table import (
    CELL_COLUMNS,
    Measure,
    markdown_table,
    result_rows,
    summarise,
    table_rows,
)


def cell(method="koap", labels=0.02, seed=0, *, successes=20, episodes=30, **more):
    asked = ("avoiding", method, labels, 1.0, seed, "trajectory", "done", "", 4, 320 + seed, 4)
    found = (episodes, successes, successes / episodes, 0.1, 0.9, 0.5 + 0.1 * seed, 2, 80.5, 1.0 + seed, None, None, "")
    row = (*asked, *found, 500, "", "mm", 12.25, 3.5, f"{method}/{labels}/{seed}")
    return dict(zip(CELL_COLUMNS, row, strict=True)) | more


def failed(reason="RuntimeError: loss | not finite", **more):
    empty = dict.fromkeys(("episodes", "successes", "success_rate", "mode_entropy", "action_error", "train_seconds"))
    return cell(**more) | empty | {"status": "failed", "reason": reason}


def test_a_file_of_cells_is_written_whole_or_not_at_all(tmp_path):
    write_csv(tmp_path / "cells.csv", CELL_COLUMNS, [failed(reason='a "quoted", reason'), cell(seed=1)])
    first, second = read_csv(tmp_path / "cells.csv")
    assert (first["reason"], first["success_rate"]) == ('a "quoted", reason', "")
    assert (second["successes"], tuple(second)) == ("20", CELL_COLUMNS)
    before = (tmp_path / "cells.csv").read_bytes()
    with pytest.raises(ValueError, match="sucesses"):
        write_csv(tmp_path / "cells.csv", CELL_COLUMNS, [cell() | {"sucesses": 3}])
    assert (tmp_path / "cells.csv").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_seeds_are_pooled():
    item = summarise([cell(seed=1, successes=15), cell(seed=0, successes=30), failed(seed=2)])[0]
    assert item.episodes == 60
    assert item.measures["success"] == Measure(0.75, *wilson_interval(45, 60))
    assert item.measures["seed_success"] == Measure(0.75, 0.5, 1.0)
    assert (item.done, item.failed, item.missing) == ((0, 1), (2,), ())
    assert item.mean("mode_entropy") == pytest.approx(0.55)
    assert item.measures["action_error"] == Measure(1.5, 1.0, 2.0)
    assert item.mean("labelled_transitions") == 320.5 and item.mean("relative_plan_error") is None
    item = summarise([cell(successes=9, episodes=10, action_error=None), cell(seed=1, successes=0)])[0]
    assert item.measures["success"].mean == 9 / 40 and item.measures["action_error"] == Measure(2.0, 2.0, 2.0)


def test_a_terminal_shows_success_or_the_action_error():
    offline = {"episodes": None, "successes": None, "relative_action_error": 0.022, "kind": "offline"}
    rows = [cell(seed=0, successes=30), cell(seed=1, successes=15), failed(labels=0.1), cell("linear") | offline]
    assert result_rows(rows) == {
        "avoiding, koap, 2 % labels": "success 75.0 % (62.8-84.2), n = 60",
        "avoiding, linear, 2 % labels": "action error 2.2 % of the mean action's",
        "avoiding, koap, 10 % labels": "no training done",
    }
    (name,) = result_rows([cell(labels=0.125, demonstrations=0.5)])
    assert name == "avoiding, koap, 12.5 % labels, 50 % of the demonstrations"


def test_nothing_is_pooled_that_differs():
    rows = [cell(), cell(labels=0.1), cell("vae"), cell(demonstrations=0.5), cell(label_unit="window")]
    items = summarise(rows + [row | {"task": "sorting"} for row in rows])
    assert len(items) == 10
    assert all(item.episodes == 30 for item in items)
    assert [item.task for item in items] == ["avoiding"] * 5 + ["sorting"] * 5


def test_shares_ascend_and_methods_keep_their_order():
    items = summarise([cell("vae", labels=0.1), cell("vae"), cell("koap", labels=0.1), cell("koap")])
    assert [(item.labels, item.method) for item in items] == [
        (share, method) for share in (0.02, 0.1) for method in ("vae", "koap")
    ]


def test_a_method_without_any_done_cell_stays():
    item = summarise([failed(seed=0), failed(seed=1)])[0]
    assert (item.mean("success"), item.episodes, item.failed) == (None, 0, (0, 1))
    assert table_rows([item])[0]["success (95 %)"] == "no cell done"


def test_a_cell_that_occurs_twice_is_refused():
    with pytest.raises(ValueError, match="avoiding, koap, 2 % labels, seed 0 occurs twice"):
        summarise([cell(), cell()])


def test_table_counts_failures_and_says_why():
    rows = [cell(), failed(seed=1), cell("vae", successes=30), cell("vae", seed=1, status="missing")]
    text = markdown_table(rows)
    lines = text.splitlines()
    assert lines[0].startswith("| labels (trajectories) | method | success (95 %) | n | seeds |")
    assert lines[2].startswith("| 2 % | koap | 66.7 % (48.8-80.8) | 30 | 1 of 2 | failed: seed 1 |")
    assert "| 1 of 2 | missing: seed 1 |" in lines[3]
    assert len({line.replace("\\|", "").count("|") for line in lines[:4]}) == 1
    assert "2 of 4 cells are not done:" in text
    assert "- avoiding, koap, 2 % labels, seed 1: failed: RuntimeError: loss | not finite" in text
    assert "- avoiding, vae, 2 % labels, seed 1: missing" in text
    assert "not done" not in markdown_table([cell()])


def test_the_labels_that_errors_are_of_are_named():
    none = {"episodes": None, "successes": None, "relative_action_error": 0.5}
    kinds = ("outside_budget", "left_out", "left_out")
    rows = [cell(labels=0.1 + i // 2, seed=i, action_errors_on=kind) | none for i, kind in enumerate(kinds)]
    assert [row["action errors on"] for row in table_rows(summarise(rows))] == [
        "left out and outside budget",
        "left out",
    ]


def test_the_unit_of_action_errors_is_that_of_the_cells():
    for unit, told in (("mrad", "mrad"), ("", "unit of the first column"), (None, "unit of the first column")):
        assert f"action error ({told})" in table_rows(summarise([cell(action_error_unit=unit)]))[0]


def test_columns_that_say_nothing_are_left_out():
    one, two = (list(table_rows(summarise(rows))[0]) for rows in ([cell()], [cell(), cell(demonstrations=0.5)]))
    assert "demonstrations used" not in one
    assert "demonstrations used" in two
    assert "task" not in one
    assert "task" in table_rows(summarise([cell(), cell(task="sorting")]))[0]
