# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's comparisons as presets: what they ask of `koap curve`, and the report over all tasks."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_koap.runs import pretrained
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.studies import paper_tables
from torchrl_koap.studies.paper_tables import PRESETS, BenchConfig, run_bench
from torchrl_koap.studies.table import read_cells, write_cells
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.training.methods import METHODS


@pytest.fixture
def asked(monkeypatch):
    """Every curve that is asked for; instead of training, each writes one finished and one failed cell."""
    curves = []
    monkeypatch.setattr(paper_tables, "check_curve", lambda options: None)

    def fake(options):
        curves.append(options)
        common = {"task": options.task, "observations": 1.0, "seed": 0, "label_unit": options.units}
        won = {"status": "done", "episodes": 10, "successes": 7, "success_rate": 0.7, "run": "cells/a"}
        lost = {"status": "failed", "reason": "no memory", "run": "cells/b"}
        options.out.mkdir(parents=True)
        level = {"fraction": get_task(options.task).label_levels[0]}
        rows = [common | level | {"method": "koap"} | won, common | level | {"method": "dd"} | lost]
        write_cells(options.out / "cells.csv", rows)

    monkeypatch.setattr(paper_tables, "run_curve", fake)
    return curves


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_presets_name_methods_tasks_and_levels_that_exist(preset):
    assert set(preset.methods.split(",")) - {"pca"} <= set(METHODS)
    assert set(preset.tasks) <= set(TASKS)
    assert all(1 <= level <= len(get_task(task).label_levels) for level in preset.levels for task in preset.tasks)


def test_a_table_is_a_curve_per_task_at_the_papers_levels(asked, tmp_path):
    result = run_bench(BenchConfig(tmp_path / "t", table=1, tasks="aligning,sorting", seeds=2, steps=7, episodes=10))
    assert [(curve.task, curve.out) for curve in asked] == [
        ("aligning", tmp_path / "t/aligning"),
        ("sorting", tmp_path / "t/sorting"),
    ]
    assert [curve.fractions for curve in asked] == ["0.02,0.05,0.1,0.25,0.5", "0.01,0.02,0.05,0.1,0.25"]
    assert [curve.first_seed_only for curve in asked] == ["0.1,0.25", "0.05,0.1"]
    assert all((curve.units, curve.denoiser, curve.denoiser_width) == ("window", "mlp", 512) for curve in asked)
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
    assert "no memory" in page and "70.0 (40-89) [80.3 +- 4.9]" in page  # KOAP on Aligning, level 1
    text = (tmp_path / "t/paper_table.md").read_text()
    assert "| aligning | 1 (2 %) | 70.0 (40-89) [80.3 +- 4.9] | failed [23.9 +- 10.9] |" in text
    assert "KOAP succeeds more often than the paper's KOAP in 1 of 2 cells." in text  # 70 against 80.3 and 61.7


def test_tasks_of_earlier_calls_stay_in_the_tables_of_a_folder(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "t", table=1, tasks="sorting"))
    result = run_bench(BenchConfig(tmp_path / "t", table=1, tasks="aligning"))
    assert [curve.task for curve in asked] == ["sorting", "aligning"]  # the first is not done again
    assert (result["done"], result["failed"]) == (2, 2)
    runs = [row["run"] for row in read_cells(tmp_path / "t/cells.csv")]
    assert runs == ["aligning/cells/a", "aligning/cells/b", "sorting/cells/a", "sorting/cells/b"]
    text = (tmp_path / "t/paper_table.md").read_text()
    assert "| aligning | 1 (2 %) |" in text and "| sorting | 1 (1 %) | 70.0 (40-89) [61.7 +- 5.6] |" in text


def test_the_observation_study_varies_what_the_controller_knows_at_fixed_labels_and_planner(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "s", study="observations"))
    run_bench(BenchConfig(tmp_path / "p", study="observations_and_planner"))
    fixed, grown = asked
    for curve in asked:
        assert (curve.task, curve.fractions, curve.observations) == ("avoiding", "0.01", "0.1,0.25,0.5,1")
        assert curve.units == "trajectory"  # 1 % of the windows would touch most trajectories, and those must stay
    assert (fixed.planner_observations, grown.planner_observations) == (1.0, None)


def test_quick_is_small_but_what_is_asked_for_stays(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "q", table=1, quick=True, tasks="avoiding", episodes=7, denoiser_width=99))
    (curve,) = asked
    assert (curve.fractions, curve.first_seed_only, curve.seeds) == ("0.02", "", 1)
    assert (curve.episodes, curve.demonstrations, curve.steps, curve.denoiser_width) == (7, 48, 2000, 99)
    assert curve.planner_from is None  # a width was asked for: the planner is trained


@pytest.mark.parametrize(
    ("asked_for", "steps"),
    [
        ({}, [5000, 8000]),  # no longer than a planner of the task
        ({"policy_steps": 900}, [900, 900]),
        ({"steps": 700}, [700, 700]),
        ({"steps": 700, "policy_steps": 900}, [900, 900]),
        ({"quick": True}, [2000, 2000]),
    ],
    ids=str,
)
def test_dp_is_trained_no_longer_than_planners_unless_an_option_says_how(asked_for, steps, asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "t", table=1, tasks="avoiding,sorting", **asked_for))
    assert [curve.policy_steps for curve in asked] == steps


def test_a_table_has_the_method_that_a_task_is_trained_with(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "t", table=1, tasks="aligning,stacking_unobserved_joints"))
    aligning, stacking = (options.methods.split(",") for options in asked)
    assert "command_regression" not in aligning and stacking == [*aligning, "command_regression"]
    run_bench(BenchConfig(tmp_path / "u", table=1, tasks="stacking_unobserved_joints", methods="koap,dd"))
    assert asked[-1].methods == "koap,dd"


def test_quick_takes_the_planners_of_the_repository_unless_told_which_or_how(asked, tmp_path, monkeypatch):
    known = {"aligning": tmp_path / "aligning", "sorting": tmp_path / "sorting"}
    for module in (paper_tables, pretrained):
        monkeypatch.setattr(module, "pretrained_folders", lambda: known)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "config.json").write_text('{"dataset": "here/demos"}')
    named = {"quick": True, "tasks": "avoiding,aligning,sorting", "planners": f"sorting={mine}"}
    run_bench(BenchConfig(tmp_path / "q", table=1, **named))
    assert [curve.planner_from for curve in asked] == [None, known["aligning"], mine]
    assert [curve.dataset for curve in asked] == ["scripted", "scripted", "here/demos"]
    for number, how in enumerate(({"steps": 40}, {"planner_seeds": 2}, {"quick": False})):
        asked.clear()
        run_bench(BenchConfig(tmp_path / f"o{number}", table=1, **named | how))
        assert [curve.planner_from for curve in asked] == [None, None, mine], how


def test_a_quick_study_has_enough_trajectories_for_one_label(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "q", study="observations", quick=True))
    (curve,) = asked
    assert curve.demonstrations is None and curve.episodes == 10


def test_planners_and_data_sets_are_named_by_task(asked, tmp_path):
    planner = tmp_path / "run"
    planner.mkdir()
    (planner / "config.json").write_text('{"dataset": "here/demos"}')
    named = {"tasks": "avoiding,sorting", "planners": f"avoiding={planner}", "dataset": "sorting=there"}
    run_bench(BenchConfig(tmp_path / "t", table=1, levels="5,1", data_share="paper", **named))
    first, second = asked
    assert (first.planner_from, first.dataset, first.data_share) == (planner, "here/demos", 0.5)
    assert (second.planner_from, second.dataset, second.data_share) == (None, "there", 0.25)
    assert (first.fractions, second.fractions) == ("0.5,0.02", "0.25,0.01")


def test_a_folder_holds_one_comparison(asked, tmp_path):
    run_bench(BenchConfig(tmp_path / "t", study="observations"))
    with pytest.raises(RunDirectoryError, match="holds another comparison than 'table 1'"):
        run_bench(BenchConfig(tmp_path / "t", table=1))
    assert len(asked) == 1


@pytest.mark.parametrize("file", ["config.json", "curve.json"])
def test_folders_of_runs_and_curves_are_left_alone(file, asked, tmp_path):
    (tmp_path / file).write_text("{}")
    with pytest.raises(RunDirectoryError, match="is the folder of a run or curve"):
        run_bench(BenchConfig(tmp_path, table=1, tasks="avoiding"))
    assert not asked and [path.name for path in tmp_path.iterdir()] == [file]


def test_wrong_calls_are_explained_before_any_work(asked, tmp_path):
    for options in (BenchConfig(tmp_path), BenchConfig(tmp_path, table=1, study="observations")):
        with pytest.raises(ValueError, match="exactly one of --table and --study"):
            run_bench(options)
    with pytest.raises(ValueError, match="unknown comparison 'table 3'"):
        run_bench(BenchConfig(tmp_path, table=3))
    with pytest.raises(ValueError, match="unknown task 'sortin'; did you mean 'sorting'"):
        run_bench(BenchConfig(tmp_path, table=1, tasks="aligning,sortin"))
    with pytest.raises(ValueError, match="'avoiding' has no label level 6: its levels 1 to 5 are 2, 5, 10, 25, 50 %"):
        run_bench(BenchConfig(tmp_path, table=1, levels="1,6"))
    with pytest.raises(ValueError, match="levels must be whole numbers with commas between, got '2 %'"):
        run_bench(BenchConfig(tmp_path, table=1, levels="2 %"))
    with pytest.raises(ValueError, match="unknown task of planners: 'sortin'; did you mean 'sorting'"):
        run_bench(BenchConfig(tmp_path, table=1, planners="sortin=run"))
    with pytest.raises(ValueError, match="dataset must be task=FOLDER with commas between, got 'demos'"):
        run_bench(BenchConfig(tmp_path, table=1, dataset="demos"))
    assert not asked


def test_a_later_task_is_checked_before_the_first_is_run(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_tables, "run_curve", lambda options: pytest.fail("work has begun"))
    with pytest.raises(ValueError, match="execution 'open_loop' was asked of dp"):
        run_bench(BenchConfig(tmp_path / "t", table=1, methods="koap,dp", execution="open_loop"))
    assert not (tmp_path / "t").exists()
