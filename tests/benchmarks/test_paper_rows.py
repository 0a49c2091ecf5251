# This source code is licensed under the MIT license found in the LICENSE file.
"""Committed cells as tables: averages over levels with an honest interval."""

import pytest

LEVELS = (0.02, 0.05, 0.1, 0.25, 0.5)


@pytest.fixture
def rows(benchmark_script, monkeypatch, made):
    module = benchmark_script("paper_rows")
    monkeypatch.setattr(module, "read_cells", made.__getitem__)
    return module


@pytest.fixture
def made():
    """Cells of comparisons by name."""
    return {}


def cell(method, fraction, successes, seconds=30.0):
    done = {"task": "avoiding", "demonstrations": 1.0, "seed": 0, "label_unit": "window", "status": "done"}
    times = {"train_seconds": seconds, "eval_seconds": 30.0}
    return done | times | {"method": method, "labels": fraction, "episodes": 60, "successes": successes}


def test_averages_have_the_interval_of_a_single_cell_and_need_all_levels(rows, made):
    cells = [cell("koap", level, count) for level, count in zip(LEVELS, (60, 54, 48, 54, 54), strict=True)]
    made["made"] = [*cells, cell("pca", 0.02, 30)]
    head, _, line = rows.bench_means("made").splitlines()
    assert "`koap`" in head and "pca" not in head
    assert "| 90.0 % (80-95) |" in line  # of 60 rollouts; of 300 it would be 86-93
    assert line.endswith("| 93.8 % |")


def test_another_method_is_counted_against_the_papers_koap(rows, made):
    cells = [cell("koap", 0.02, 60), cell("pca", 0.02, 60), cell("pca", 0.05, 40), cell("koap", 0.05, 60)]
    made["made"] = cells
    assert rows.bench_sentence("made") == "2 of 2"
    assert rows.bench_sentence("made", "pca") == "1 of 2"  # the paper's KOAP has 78.0 and 98.05 %


def test_seeds_of_a_cell_with_the_fewest_labels_are_counted_together(rows, made):
    cells = [
        cell("dp", 0.02, 20) | {"seed": 1},
        cell("dp", 0.02, 30),
        cell("dp", 0.5, 45),
        cell("dp", 0.5, 9) | {"seed": 1},
    ]
    made["made"] = cells
    assert rows.bench_pooled("made", "avoiding", "dp") == "42 (33-51) %"  # 50 of 120


def test_cells_of_another_comparison_stand_beside(rows, made):
    made["first"] = [cell("koap", 0.02, 60), cell("koap", 0.05, 30), cell("pca", 0.02, 0)]
    made["made"] = [cell("relabel", 0.02, 30)]
    head, _, line = rows.bench_table("made", "first", ("koap",)).splitlines()
    assert "koap" in head and "pca" not in head and "100.0 (94-100)" in line and "50.0 (38-62)" in line  # level 1 alone


def test_a_study_of_observations_has_a_row_per_share(rows, made):
    few = cell("koap", 0.01, 30) | {"demonstrations": 0.1}
    made["made"] = [cell("koap", 0.01, 60), cell("pca", 0.01, 15), few]
    head, _, first, second = rows.observation_table("made").splitlines()
    assert first.startswith("| 10 % | 50.0 %") and first.endswith("| not run |") and "`pca`" in head
    assert second.startswith("| 100 % | 100.0 %")
