# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the cells that a study defines: shared planners, defaults of methods, presets of the paper."""

from dataclasses import replace
from pathlib import Path

import pytest
from offline_runs import save_arm
from tiny_runs import TINY, koap

from torchrl_koap import ControllerConfig, EvalConfig, ExecutionConfig, LabelConfig, PlannerConfig, RunConfig
from torchrl_koap.runs.run_directory import RunDirectoryError, pretrained_folders
from torchrl_koap.runs.weights import CheckpointError
from torchrl_koap.studies import Study, run_study
from torchrl_koap.studies.study import PRESETS, check_study, complete
from torchrl_koap.tasks import TASKS, Action, Task, get_task
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import METHODS


@pytest.fixture
def asked(demonstrations, tmp_path):
    def make(**options):
        options = {"labels": (0.5,), "seeds": 2, "datasets": (str(demonstrations),)} | options
        study = complete(Study(out=tmp_path / "study", **options))
        return study, check_study(study)

    return make


def test_cells_of_a_seed_share_a_planner_of_that_seed(asked):
    planner = PlannerConfig(network="mlp", width=64)
    study, cells = asked(methods=("koap", "dp"), planner=planner, controller=ControllerConfig(steps=7))
    assert [cell.folder for cell in cells] == [
        f"cells/avoiding/{method}-0.5-1-seed{seed}" for seed in (0, 1) for method in ("koap", "dp")
    ]
    for cell in cells:
        shared = study.out / f"planners/avoiding/1-seed{cell.seed}"
        config = study.train_config(cell)
        if cell.method == "koap":
            alone = study.planner_config(cell)
            assert (alone.out, alone.planner, alone.labels.fraction) == (shared, planner, None)
            assert (alone.run.seed, alone.run.threads) == (cell.seed, 1)
        assert (config.labels.fraction, config.run.seed, config.controller.steps) == (0.5, cell.seed, 7)
        assert config.run.threads == study.eval_config(cell).threads == 1
        expected = planner if cell.method == "dp" else PlannerConfig(source=shared)
        assert config.planner == expected and config.out == study.out / cell.folder


def test_a_planner_per_share_of_the_demonstrations(asked):
    study, cells = asked(methods=("koap",), demonstrations=(0.5, 1.0), seeds=3)
    assert {study.planner_folder(cell).name for cell in cells} == {f"{a}-seed{s}" for a in (0.5, 1) for s in range(3)}
    half = study.planner_config(cells[0])
    assert (half.labels.trajectories, half.run.seed) == (0.5, 0)
    study, cells = asked(methods=("koap",), demonstrations=(0.5,), label_unit="window")
    wanted = LabelConfig(fraction=0.5, unit="window", trajectories=0.5)
    assert {study.train_config(cell).labels for cell in cells} == {wanted}


def test_every_training_seed_meets_noise_of_its_own(asked):
    study, cells = asked(methods=("koap", "dd"), seeds=3, evaluation=EvalConfig(episodes=2))
    found = {(cell.method, cell.seed): study.eval_config(cell) for cell in cells}
    assert [found["koap", seed].seed for seed in range(3)] == [EvalConfig.seed, 1100, 2100]
    assert found["koap", 2] == found["dd", 2] and found["dd", 0].episodes == 2
    study, cells = asked(methods=("koap",), run=RunConfig(plugins=("json",)))
    assert study.eval_config(cells[0]).plugins == study.train_config(cells[0]).run.plugins == ("json",)


def test_koap_paper_is_measured_as_published_unless_told_otherwise(asked):
    study, cells = asked(methods=("koap_paper", "koap"), seeds=1)
    published, own = (study.train_config(cell) for cell in cells)
    published, own = (resolve(replace(c, planner=study.planner), get_task("avoiding")) for c in (published, own))
    assert (published.controller.columns, published.execution.strategy) == ("all", "open_loop")
    assert (own.controller.columns, own.execution.strategy) == ("robot", "feedback")
    study, (cell,) = asked(methods=("koap_paper",), seeds=1, execution=ExecutionConfig(strategy="feedback"))
    config = replace(study.train_config(cell), planner=study.planner)
    assert resolve(config, get_task("avoiding")).execution.strategy == "feedback"


def test_a_planner_of_another_run_is_taken_over_or_refused(asked, demonstrations, tmp_path):
    run = tmp_path / "run"
    assert koap("train", "--out", run, "--dataset", demonstrations, "--method", "linear", *TINY) == 0
    study, cells = asked(methods=("koap",), planners=(str(run),))
    assert {study.planner_folder(cell) for cell in cells} == {run}
    with pytest.raises(RunDirectoryError):
        asked(methods=("koap",), planners=(str(tmp_path / "none"),))
    sorting = f"avoiding={pretrained_folders()['sorting']}"
    with pytest.raises(CheckpointError, match="was trained on task 'sorting', not on 'avoiding'"):
        asked(methods=("koap",), planners=(sorting,))
    assert not study.out.exists()
    wide = PlannerConfig(width=64)
    with pytest.raises(ValueError, match="planner options have no effect"):
        asked(methods=("koap",), planners=("pretrained:avoiding",), planner=wide)
    asked(methods=("koap", "dp"), planners=("pretrained:avoiding",), planner=wide)  # of dp
    one_of_two = {"tasks": ("avoiding", "sorting"), "datasets": (), "planners": ("avoiding=pretrained:avoiding",)}
    asked(methods=("koap",), planner=wide, **one_of_two)  # of sorting
    named, _ = asked(methods=("koap",), planners=("pretrained:avoiding",))
    assert named.planners == (f"avoiding={pretrained_folders()['avoiding'].absolute()}",)


def test_a_number_to_record_is_refused_where_nothing_is_recorded(demonstrations, tmp_path):
    given = {"out": tmp_path / "study", "datasets": (f"avoiding={demonstrations}",)}
    with pytest.raises(ValueError, match="record 24 has no effect: all demonstrations are given with --datasets"):
        complete(Study(record=24, **given))
    assert complete(Study(preset="quick", tasks=("avoiding",), **given)).record == 48  # not asked for
    assert complete(Study(record=24, tasks=("avoiding", "sorting"), **given)).record == 24


def test_data_are_needed_where_there_is_no_environment(tmp_path, monkeypatch):
    arm = Task(name="bare_arm", observation_parts={"q": 2}, actions={"dq": Action("rad")}, position="q")
    monkeypatch.setitem(TASKS, "bare_arm", arm)
    with pytest.raises(ValueError, match="task 'bare_arm' has no environment to record demonstrations in"):
        run_study(Study(out=tmp_path / "out", tasks=("bare_arm",)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", PRESETS)
def test_presets_name_methods_tasks_and_levels_that_exist(name, tmp_path):
    study = complete(Study(out=tmp_path / "study", preset=name))
    assert check_study(study) and study.planner.held_out == 0.0  # as in the paper
    assert set(PRESETS[name]["methods"]) <= set(METHODS) and set(PRESETS[name]["tasks"]) <= set(TASKS)


def test_a_table_is_the_papers_tasks_at_its_levels(tmp_path):
    study = complete(Study(out=tmp_path, preset="table1", tasks=("aligning", "sorting"), methods=("koap",), seeds=1))
    assert (study.label_unit, study.labels, study.planner) == ("window", (), PlannerConfig(held_out=0.0))
    shares = {task: [cell.labels for cell in study.cells() if cell.task == task] for task in study.tasks}
    assert shares == {"aligning": [0.02, 0.05, 0.1, 0.25, 0.5], "sorting": [0.01, 0.02, 0.05, 0.1, 0.25]}
    assert [config.split("=")[0] for config in study.datasets] == []


def test_what_is_asked_for_wins_over_the_preset(tmp_path):
    own = {"planner": PlannerConfig(width=99), "evaluation": EvalConfig(episodes=7), "labels": (0.3,)}
    study = complete(Study(out=tmp_path, preset="quick", tasks=("avoiding",), run=RunConfig(logger="wandb"), **own))
    assert (study.planner.width, study.planner.steps, study.evaluation.episodes) == (99, 2000, 7)
    assert (study.labels, study.levels, study.seeds, study.record) == ((0.3,), (), 1, 48)
    assert (study.run.logger, study.preset) == ("wandb", None)


@pytest.mark.parametrize(
    ("section", "option"),
    [
        ("run", {"seed": 3}),
        ("run", {"threads": 2}),
        ("planner", {"source": "x"}),
        ("evaluation", {"threads": 2}),
        ("evaluation", {"plugins": ("mine",)}),
        ("evaluation", {"execution": ExecutionConfig(blend=0.5)}),
    ],
)
def test_what_a_study_decides_is_refused(section, option, asked):
    config = {"run": RunConfig, "planner": PlannerConfig, "evaluation": EvalConfig}[section](**option)
    with pytest.raises(ValueError, match=f"{section}.{next(iter(option))} is not for a study: "):
        asked(methods=("koap",), **{section: config})


def test_a_data_set_alone_brings_its_task(tmp_path):
    study = complete(Study(out=tmp_path / "s", datasets=(str(save_arm(tmp_path / "arm", joints=2)),)))
    assert study.tasks == ("arm",) and study.task("arm").action_dim == 2
    assert study.train_config(study.cells()[0]).dataset == str(tmp_path / "arm")


def test_data_and_planners_are_named_by_task(tmp_path):
    Path(tmp_path / "data").mkdir()
    study = Study(out=tmp_path / "s", tasks=("avoiding", "sorting"), datasets=(f"sorting={tmp_path / 'data'}",))
    assert complete(study).datasets == (f"sorting={tmp_path / 'data'}",)
    for wrong, message in (("demos", "must be TASK=FOLDER"), ("sortin=x", "unknown task of datasets: 'sortin'")):
        with pytest.raises(ValueError, match=message):
            complete(replace(study, datasets=(wrong,)))
    with pytest.raises(ValueError, match="datasets names task 'sorting' twice"):
        complete(replace(study, datasets=study.datasets * 2))


def test_several_data_sets_must_name_their_tasks(tmp_path):
    places = [tmp_path / name for name in ("one", "two")]
    for place in places:
        save_arm(place)
    with pytest.raises(ValueError, match="must be TASK=FOLDER if there are several"):
        complete(Study(out=tmp_path / "s", datasets=tuple(map(str, places))))
    assert complete(Study(out=tmp_path / "s", datasets=(str(places[0]),))).tasks == ("arm",)


def test_the_controls_are_run_unless_methods_are_named(tmp_path):
    assert {"koap_untrained", "linear_steps"} <= set(complete(Study(out=tmp_path / "s")).methods)


def test_what_evaluation_would_refuse_is_refused_before_any_training(tmp_path):
    for task, options, message in (
        ("aligning", {"episodes": 61}, "there are 60"),
        ("avoiding", {"rollouts_per_context": 2}, "has no contexts"),
        ("aligning", {"contexts_file": "nowhere.pkl"}, "contexts_file: there is no file nowhere.pkl"),
        ("arm", {"episodes": 10}, "no environment to roll out in"),
    ):
        datasets = (str(save_arm(tmp_path / "arm", joints=2)),) if task == "arm" else ()
        study = Study(out=tmp_path / "s", tasks=(task,), datasets=datasets, evaluation=EvalConfig(**options))
        with pytest.raises(ValueError, match=message):
            check_study(complete(study))
