# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's comparisons as presets: what they ask of `koap curve`, and the report over all tasks."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_koap.studies import paper_tables
from torchrl_koap.studies.paper_tables import PRESETS, BenchConfig, run_bench
from torchrl_koap.studies.table import read_cells, write_cells
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.training.methods import METHODS
from torchrl_koap.training.run_directory import RunDirectoryError


@pytest.fixture
def asked(monkeypatch):
    """Every curve that is asked for; instead of training, each writes one finished and one failed cell."""
    curves = []

    def fake(options):
        curves.append(options)
        common = {"task": options.task, "observations": 1.0, "seed": 0, "label_unit": options.units}
        won = {"status": "done", "episodes": 10, "successes": 7, "success_rate": 0.7, "run": "cells/a"}
        lost = {"status": "failed", "reason": "no memory", "run": "cells/b"}
        options.out.mkdir(parents=True)
        rows = [common | {"method": "koap", "fraction": 0.01} | won, common | {"method": "dd", "fraction": 0.01} | lost]
        write_cells(options.out / "cells.csv", rows)

    monkeypatch.setattr(paper_tables, "run_curve", fake)
    return curves


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_presets_name_methods_tasks_and_levels_that_exist(preset):
    assert set(preset.methods.split(",")) <= set(METHODS)
    assert set(preset.tasks) <= set(TASKS)
    assert all(1 <= level <= len(get_task(task).label_levels) for level in preset.levels for task in preset.tasks)


def test_a_table_is_a_curve_per_task_at_the_papers_levels(asked, tmp_path):
    result = run_bench(BenchConfig(tmp_path / "t", table=1, tasks="aligning,sorting", seeds=2, steps=7, episodes=10))
    assert [(curve.task, curve.out) for curve in asked] == [
        ("aligning", tmp_path / "t/aligning"),
        ("sorting", tmp_path / "t/sorting"),
    ]
    assert all(curve.units == "window" and curve.fractions == "0.01,0.02,0.05,0.1,0.25" for curve in asked)
    assert all((curve.seeds, curve.steps, curve.episodes) == (2, 7, 10) for curve in asked)
    assert (result["done"], result["failed"], result["missing"]) == (2, 2, 0)
    rows = read_cells(tmp_path / "t/cells.csv")
    assert [row["run"] for row in rows] == [
        "aligning/cells/a",
        "aligning/cells/b",
        "sorting/cells/a",
        "sorting/cells/b",
    ]
    page = Path(result["report"]).read_text()
    assert "no memory" in page and "80" in page  # KOAP on Aligning, level 1, in the paper: 80 %


def test_the_observation_study_varies_what_is_known_at_fixed_labels(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "s", study="observations"))
    (curve,) = asked
    assert (curve.task, curve.fractions, curve.observations) == ("avoiding", "0.02", "0.1,0.25,0.5,1")
    assert curve.units == "trajectory"  # 2 % of the windows would touch most trajectories, and those must stay


def test_a_folder_holds_one_comparison(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "t", study="observations"))
    with pytest.raises(RunDirectoryError, match="holds another comparison than 'table 1'"):
        run_bench(BenchConfig(tmp_path / "t", table=1))
    assert len(asked) == 1


def test_wrong_calls_are_explained_before_any_work(asked, tmp_path):
    for options in (BenchConfig(tmp_path), BenchConfig(tmp_path, table=1, study="observations")):
        with pytest.raises(ValueError, match="exactly one of --table and --study"):
            run_bench(options)
    with pytest.raises(ValueError, match="unknown comparison 'table 3'"):
        run_bench(BenchConfig(tmp_path, table=3))
    with pytest.raises(ValueError, match="unknown task 'sortin'; did you mean 'sorting'"):
        run_bench(BenchConfig(tmp_path, table=1, tasks="aligning,sortin"))
    assert not asked
