# This source code is licensed under the MIT license found in the LICENSE file.
"""The table of a curve: each finished cell is read once; two thousand of them are no burden."""

from __future__ import annotations

import json
import time

import pytest

from torchrl_koap.studies import curve_table
from torchrl_koap.studies.cells import Cell
from torchrl_koap.studies.curve_table import CurveTable
from torchrl_koap.studies.table import read_cells

LABELS = {"selected_units": 1, "labelled_transitions": 20, "trajectories_touched": 1}
RESULT = {"episodes": 60, "success_rate": 0.5, "success_low": 0.4, "success_high": 0.6, "mode_entropy": 0.3}
RESULT |= {"collisions": 2, "mean_steps": 70.5}


def finish(root, cell):
    """The files of a cell that was trained and evaluated."""
    folder = root / cell.folder
    folder.mkdir(parents=True)
    done = {"labels": LABELS, "train_seconds": 1.0, "eval_seconds": 1.0, "episodes": 60, "successes": 30}
    rows = [{"seed": seed, "outcome": "success", "mode": 1, "steps": 70} for seed in range(60)]
    files = {"cell.json": done, "summary.json": {"controller_updates": 0}, "eval.json": RESULT | {"episode": rows}}
    for name, content in files.items():
        (folder / name).write_text(json.dumps(content))


def cells(number):
    return [Cell("linear", 0.5, 1.0, seed) for seed in range(number)]


def test_a_cell_is_read_when_it_has_ended_and_not_again(tmp_path, monkeypatch):
    read = []
    original = curve_table.cell_row
    monkeypatch.setattr(
        curve_table, "cell_row", lambda root, cell, **options: read.append(cell.seed) or original(root, cell, **options)
    )
    monkeypatch.setattr(curve_table, "EVERY", 0.0)
    monkeypatch.setattr(curve_table, "_SHARE", 1e9)
    table = CurveTable(tmp_path, cells(3), task="avoiding", label_unit="trajectory")
    assert read == [0, 1, 2] and not any(table.is_done(cell) for cell in cells(3))
    finish(tmp_path, cells(3)[1])
    table.ended(cells(3)[1], None)
    table.ended(cells(3)[2], "no memory")
    assert read == [0, 1, 2, 1, 2] and table.is_done(cells(3)[1])
    assert [row["status"] for row in read_cells(tmp_path / "cells.csv")] == ["missing", "done", "failed"]


def test_the_table_of_a_curve_that_goes_on_reads_each_cell_once(tmp_path, monkeypatch):
    """What was finished before, and what another cell ended after, is not read again; the table holds all of it."""
    for cell in cells(30)[:25]:
        finish(tmp_path, cell)
    read = []
    original = curve_table.cell_row
    monkeypatch.setattr(
        curve_table, "cell_row", lambda root, cell, **options: read.append(cell.seed) or original(root, cell, **options)
    )
    table = CurveTable(tmp_path, cells(30), task="avoiding", label_unit="trajectory")
    todo = [cell for cell in cells(30) if not table.is_done(cell)]
    for cell in todo:
        finish(tmp_path, cell)
        table.ended(cell, None)
    table.write()
    assert read == [*range(30), *range(25, 30)]
    assert [row["status"] for row in read_cells(tmp_path / "cells.csv")] == 30 * ["done"]


@pytest.mark.faults
def test_two_thousand_cells(tmp_path):
    for cell in cells(2000):
        finish(tmp_path, cell)
    began = time.process_time()
    table = CurveTable(tmp_path, cells(2000), task="avoiding", label_unit="trajectory")
    assert all(table.is_done(cell) for cell in cells(2000))
    for cell in cells(2000)[:50]:
        table.ended(cell, None)
    table.write()
    assert time.process_time() - began < 10
