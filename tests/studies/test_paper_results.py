# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's tables as data: all 165 cells at the right levels, None for what it does not have."""

from __future__ import annotations

import pytest

from torchrl_koap.studies.paper_results import (
    paper_cell,
    paper_cells,
    paper_levels,
    paper_points,
    paper_share,
    paper_success,
)
from torchrl_koap.tasks import TASKS, get_task


def test_both_tables_are_whole():
    first, second = paper_cells(1), paper_cells(2)
    tasks = ["avoiding", "aligning", "sorting", "po_sorting", "stacking_unobserved_joints"]
    places = {(cell.task, cell.method, cell.level) for cell in first if cell.task in tasks}
    assert places == {(t, m, n) for t in tasks for m in ("dp", "dd", "vae", "lapo", "koap") for n in range(1, 6)}
    places = {(cell.task, cell.method, cell.level) for cell in second if cell.task in tasks}
    methods = ("koap", "nonlinear", "pretrain", "relabel")
    assert places == {(t, m, n) for t in (tasks[0], tasks[4]) for m in methods for n in range(1, 6)}
    assert all(0 <= cell.success <= 1 and 0 <= cell.spread < 0.25 for cell in first + second)


@pytest.mark.parametrize(
    ("task", "method", "level", "share", "text"),
    [
        ("avoiding", "koap", 1, 0.02, "78.0 +- 8.6"),
        ("avoiding", "dp", 5, 0.5, "94.7 +- 1.8"),
        ("aligning", "koap", 5, 0.5, "92.0 +- 5.4"),
        ("sorting", "dd", 2, 0.02, "49.7 +- 7.6"),
        ("po_sorting", "vae", 3, 0.05, "16.4 +- 1.9"),
        ("stacking_unobserved_joints", "koap", 4, 0.1, "37.0 +- 10.8"),
        ("stacking_1", "koap", 4, 0.1, "37.0 +- 10.8"),
        ("avoiding", "relabel", 1, 0.02, "5.8 +- 11.0"),
    ],
)
def test_single_cells(task, method, level, share, text):
    cell = paper_cell(task, method, level)
    assert (cell.label_share, cell.text) == (share, text)


def test_koap_of_both_tables_is_the_same():
    second = {(cell.task, cell.level): cell.text for cell in paper_cells(2) if cell.method == "koap"}
    assert second and all(paper_cell(task, "koap", level).text == text for (task, level), text in second.items())


def test_levels_are_those_of_the_tasks():
    for name, task in TASKS.items():
        if paper_levels(name):
            assert paper_levels(name) == task.label_levels
    assert get_task("aligning").label_levels == (0.02, 0.05, 0.1, 0.25, 0.5)
    assert get_task("po_sorting").label_levels == (0.01, 0.02, 0.05, 0.1, 0.25)


def test_what_the_paper_does_not_have_is_none():
    assert paper_success("aligning", "koap_untrained", 2) is None and paper_cell("sorting_2", "koap", 1) is None
    assert paper_levels("stacking") == () and paper_share("stacking") is None
    assert paper_points("sorting_6") == []
    assert (paper_share("aligning"), paper_share("po_sorting")) == (0.5, 0.25)


def test_points_lie_at_the_papers_shares():
    rows = [row for row in paper_points("avoiding") if row["method"] == "koap"]
    assert [(row["fraction"], row["success"]) for row in rows] == [
        (0.02, pytest.approx(0.7803)),
        (0.05, pytest.approx(0.9805)),
        (0.1, pytest.approx(0.9722)),
        (0.25, pytest.approx(0.9833)),
        (0.5, pytest.approx(0.975)),
    ]
    assert {row["fraction"] for row in paper_points("avoiding", [0.5])} == {0.5}


def test_an_unknown_table_is_refused():
    with pytest.raises(ValueError, match="unknown table of the paper '3'"):
        paper_cells(3)
