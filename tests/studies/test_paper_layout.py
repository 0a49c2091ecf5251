# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's layout: every cell in its place beside the paper's, averages over whole rows of tasks alone."""

from __future__ import annotations

import pytest

from torchrl_koap.studies import paper_layout
from torchrl_koap.studies.paper_layout import (
    DEFAULT,
    above_the_paper,
    average_over_tasks,
    default_entries,
    layout_rows,
    paper_entries,
    plot_average,
    write_paper_layout,
)


def cell(task, method, fraction, successes=None, seed=0):
    row = {"task": task, "method": method, "fraction": fraction, "seed": seed, "status": "missing"}
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


def test_an_average_is_over_all_tasks_or_none():
    averages = average_over_tasks(paper_entries(ROWS))
    assert set(averages) == {"koap"}  # dp was not run on Sorting
    ((level, mean, low, high),) = averages["koap"]  # nor anything at level 5 of it
    assert level == 1 and mean == pytest.approx((0.9 + 0.55) / 2)
    halves = [(0.9 - 0.79854, 0.95341 - 0.9), (0.55 - 0.46081, 0.63614 - 0.55)]  # of the cells' Wilson intervals
    assert low == pytest.approx(mean - (halves[0][0] ** 2 + halves[1][0] ** 2) ** 0.5 / 2, abs=1e-3)
    assert high == pytest.approx(mean + (halves[0][1] ** 2 + halves[1][1] ** 2) ** 0.5 / 2, abs=1e-3)


def test_what_is_written(tmp_path):
    made = write_paper_layout(tmp_path, ROWS)
    assert made["sentence"] in (tmp_path / "paper_table.md").read_text()
    assert (tmp_path / made["picture"]).stat().st_size > 1000
    assert write_paper_layout(tmp_path, [cell("sorting", "koap", 0.01)])["picture"] is None
    with pytest.raises(ValueError, match="nothing to average"):
        plot_average(paper_entries([cell("sorting", "koap", 0.01)]), tmp_path / "a.png")


def test_default_methods_are_one_line_where_tasks_differ(tmp_path, monkeypatch):
    here = "stacking_unobserved_joints"
    rows = [cell("avoiding", "koap", 0.02, 54), cell(here, "koap", 0.01, 0), cell(here, "command_regression", 0.01, 30)]
    entries = paper_entries(rows)
    assert {(entry.task, entry.success) for entry in default_entries(entries)} == {("avoiding", 0.9), (here, 0.5)}
    ((level, mean, *_),) = average_over_tasks(default_entries(entries))[DEFAULT]
    assert (level, mean) == (1, pytest.approx(0.7))
    drawn = {}
    monkeypatch.setattr(paper_layout, "draw_lines", lambda axes, lines, **_: drawn.update({x.name: x for x in lines}))
    monkeypatch.setattr(paper_layout, "name_lines", lambda *_: None)
    plot_average(entries, tmp_path / "two.png")
    assert {name: line.y for name, line in drawn.items()} == {DEFAULT: [pytest.approx(70.0)], "koap": [45.0]}
    assert not drawn[DEFAULT].paper and drawn["koap"].paper
    drawn.clear()
    plot_average(paper_entries(ROWS), tmp_path / "one.png")  # both are trained with koap
    assert set(drawn) == {"koap"}
