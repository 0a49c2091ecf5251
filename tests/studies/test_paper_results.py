# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's figures: every one has a source, tasks exist, what is not known is None."""

from __future__ import annotations

import json
from importlib.resources import files

import pytest

from torchrl_koap.studies.paper_results import paper_points, paper_rows, paper_success
from torchrl_koap.tasks import get_task


def test_known_figures():
    known = {
        "aligning": (0.80, 0.92),
        "sorting": (0.62, 0.66),
        "po_sorting": (0.46, 0.58),
        "stacking_1": (0.27, 0.46),
    }
    for task, (lowest, highest) in known.items():
        assert paper_success(task, "koap", 1) == pytest.approx(lowest)
        assert paper_success(task, "koap", 5) == pytest.approx(highest)
    assert len(paper_rows()) == 8


def test_what_is_not_known_is_none_not_invented():
    assert paper_success("aligning", "koap", 2) is None
    assert paper_success("aligning", "supervised", 1) is None
    assert paper_success("avoiding", "koap", 1) is None
    assert paper_points("avoiding", (0.01, 0.25)) == []


def test_every_entry_is_whole():
    rows = paper_rows()
    assert len({(row["task"], row["method"], row["level"]) for row in rows}) == len(rows)
    for row in rows:
        assert 0 <= row["success"] <= 1
        assert 1 <= row["level"] <= len(get_task(row["task"]).label_levels)
        assert "2410.07584" in row["source"]
    content = json.loads(files("torchrl_koap.studies").joinpath("paper_results.json").read_text())
    assert content["missing"]
    assert "2410.07584" in content["paper"]


def test_points_lie_at_the_levels_of_the_task():
    levels = get_task("stacking_1").label_levels
    points = paper_points("stacking_1", levels)
    assert [(row["fraction"], row["success"]) for row in points] == [(levels[0], 0.27), (levels[4], 0.46)]
    assert [row["fraction"] for row in paper_points("stacking_1", (0.03,))] == [0.03]


def test_unknown_table_suggests_the_nearest():
    with pytest.raises(ValueError, match="unknown table of the paper 'sucess'; did you mean 'success'"):
        paper_rows("sucess")
