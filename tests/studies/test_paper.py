# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the paper's tables as data, measured cells in their layout, averages over complete tasks."""

import pytest

from torchrl_koap.studies.paper import (
    above_the_paper,
    all_paper_cells,
    average_over_tasks,
    layout_rows,
    paper_cells,
    paper_entries,
    paper_points,
    write_paper_layout,
)
from torchrl_koap.tasks import get_task


def test_both_tables_are_whole():
    first, second = paper_cells(1), paper_cells(2)
    tasks = ["avoiding", "aligning", "sorting", "po_sorting", "stacking_unobserved_joints"]
    places = {(cell.task, cell.method, cell.level) for cell in first if cell.task in tasks}
    assert places == {(t, m, n) for t in tasks for m in ("dp", "dd", "vae", "lapo", "koap") for n in range(1, 6)}
    places = {(cell.task, cell.method, cell.level) for cell in second if cell.task in tasks}
    methods = ("koap", "nonlinear", "pretrain", "relabel")
    assert places == {(t, m, n) for t in (tasks[0], tasks[4]) for m in methods for n in range(1, 6)}
    assert all(0 <= cell.success <= 1 and 0 <= cell.spread < 0.25 for cell in first + second)
    assert len([cell for cell in first + second if cell.task != "stacking_1"]) == 165


@pytest.mark.parametrize(
    ("task", "method", "level", "share", "text"),
    [
        ("avoiding", "koap", 1, 0.02, "78.0 +- 8.6"),
        ("stacking_unobserved_joints", "koap", 4, 0.1, "37.0 +- 10.8"),
        ("avoiding", "relabel", 1, 0.02, "5.8 +- 11.0"),
    ],
)
def test_single_cells(task, method, level, share, text):
    cell = all_paper_cells()[task, method, level]
    assert (cell.label_share, cell.text) == (share, text)


def test_levels_are_those_of_the_tasks():
    for task in {cell.task for cell in paper_cells(1)}:
        assert tuple(share for share, _ in paper_points(task)["koap"]) == get_task(task).label_levels
    assert paper_points("avoiding")["koap"][:2] == [(0.02, 0.7803), (0.05, 0.9805)]


def cell(task, method, labels, successes=None, seed=0):
    row = {"task": task, "method": method, "labels": labels, "seed": seed, "status": "missing"}
    row |= {"demonstrations": 1.0, "label_unit": "window"}
    return row if successes is None else row | {"status": "done", "episodes": 60, "successes": successes}


ROWS = [
    cell("avoiding", "koap", 0.02, 54),
    cell("avoiding", "dp", 0.02, 6),
    cell("avoiding", "koap", 0.5, 57),
    cell("sorting", "koap", 0.01, 30),
    cell("sorting", "koap", 0.01, 36, seed=1),
    cell("sorting", "dp", 0.01),
    cell("sorting", "koap", 0.03, 36),  # no level of the task
]


def test_cells_stand_at_their_levels_beside_the_papers():
    assert layout_rows(paper_entries(ROWS)) == [
        {
            "task": "avoiding",
            "level": "1 (2 %)",
            "koap": "90.0 (80-95) [78.0 +- 8.6]",
            "dp": "10.0 (5-20) [6.9 +- 4.5]",
        },
        {"task": "avoiding", "level": "5 (50 %)", "koap": "95.0 (86-98) [97.5 +- 1.6]", "dp": "not run [94.7 +- 1.8]"},
        {"task": "sorting", "level": "1 (1 %)", "koap": "55.0 (46-64) [61.7 +- 5.6]", "dp": "not run [0.0 +- 0.0]"},
    ]
    assert above_the_paper(paper_entries(ROWS)) == (1, 3)


def test_a_cell_that_failed_is_said():
    broken = {"status": "failed"}
    rows = [cell("sorting", "koap", 0.01, 30), cell("sorting", "koap", 0.01, seed=1) | broken]
    (row,) = layout_rows(paper_entries([*rows, cell("sorting", "dp", 0.01) | broken]))
    assert row["koap"] == "50.0 (38-62), 1 failed [61.7 +- 5.6]" and row["dp"] == "failed [0.0 +- 0.0]"


def test_an_average_is_over_all_tasks_or_none():
    averages = average_over_tasks(paper_entries(ROWS))
    assert set(averages) == {"koap"}  # dp was not run on Sorting
    ((level, mean, low, high, paper),) = averages["koap"]  # nor anything at level 5 of it
    assert paper == pytest.approx((0.7803 + 0.6165) / 2)
    assert level == 1 and mean == pytest.approx((0.9 + 0.55) / 2)
    halves = [(0.9 - 0.79854, 0.95341 - 0.9), (0.55 - 0.46081, 0.63614 - 0.55)]  # of the cells' Wilson intervals
    assert low == pytest.approx(mean - (halves[0][0] ** 2 + halves[1][0] ** 2) ** 0.5 / 2, abs=1e-3)
    assert high == pytest.approx(mean + (halves[0][1] ** 2 + halves[1][1] ** 2) ** 0.5 / 2, abs=1e-3)


def test_the_papers_average_is_over_the_same_tasks_or_none():
    both = [cell(task, "nonlinear", share, 30) for task, share in (("avoiding", 0.02), ("sorting", 0.01))]
    ((*_, paper),) = average_over_tasks(paper_entries(both))["nonlinear"]
    assert paper is None and all_paper_cells()["avoiding", "nonlinear", 1].success > 0


def test_what_is_written(tmp_path):
    made = write_paper_layout(tmp_path, ROWS)
    assert "Rollouts per cell (n): 60, 120; table.md has that of each." in made["sentence"]
    assert made["sentence"] in (tmp_path / "paper_table.md").read_text()
    assert (tmp_path / made["picture"]).stat().st_size > 1000
    one = [cell("sorting", "koap", 0.01, 30)]  # its own picture of success shows the same
    assert write_paper_layout(tmp_path, one)["picture"] is None
    no_level = write_paper_layout(tmp_path / "none", [cell("sorting", "koap", 0.03, 30)])
    assert no_level["rows"] == [] and not (tmp_path / "none").exists()
