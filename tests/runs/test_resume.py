# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that a resumed run keeps its original options."""

from dataclasses import replace

import pytest
from torchrl._utils import logger

from torchrl_koap import LabelConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.runs.config_files import to_json, versions
from torchrl_koap.runs.resume import begun_with, check_data, check_resume
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError

SAVED = TrainConfig(
    dataset="/no/longer/there",
    out="run",
    labels=LabelConfig(fraction=0.5),
    planner=PlannerConfig(steps=7),
    run=RunConfig(seed=3, threads=2),
)
RESUME = RunConfig(resume=True)


@pytest.fixture
def run(tmp_path):
    run = RunDirectory(tmp_path / "run")
    run.write_json("config.json", to_json(SAVED) | {"data": {"steps": 5, "sha256": "a"}, "versions": versions()})
    return run


def test_omitted_options_keep_their_value(run):
    config = begun_with(run, TrainConfig(dataset=".", out="elsewhere", run=RESUME))
    assert config == replace(SAVED, dataset=".", out=config.out, run=replace(SAVED.run, resume=True))
    with pytest.raises(RunDirectoryError, match="'/no/longer/there' of .*run is not there .* with --dataset"):
        begun_with(run, TrainConfig(out="run", run=RESUME))
    asked = begun_with(run, TrainConfig(dataset=".", out="run", labels=LabelConfig(count=3), run=RESUME))
    assert asked.labels == LabelConfig(count=3) and asked.planner.steps == 7
    fresh = TrainConfig(out="run")
    assert begun_with(run, fresh) is fresh


def test_a_folder_without_a_run_is_not_resumed(tmp_path):
    nowhere = RunDirectory(tmp_path / "arm3")
    with pytest.raises(RunDirectoryError, match="arm3 holds no run to resume"):
        begun_with(nowhere, TrainConfig(out=nowhere.path, run=RESUME))
    fresh = TrainConfig(dataset="arm", out=nowhere.path, run=RESUME)
    assert begun_with(nowhere, fresh) is fresh


def test_moved_folders_and_other_thread_counts_can_be_resumed(run, tmp_path):
    check_resume(run, replace(SAVED, dataset="/moved", run=replace(SAVED.run, resume=True, threads=1)))
    run.write_json("config.json", to_json(replace(SAVED, dataset=str(tmp_path))))  # a copy: both are there
    check_resume(run, replace(SAVED, dataset="/scratch/copy", run=replace(SAVED.run, resume=True)))
    built_on = replace(SAVED, planner=PlannerConfig(source="/no/longer/there"))  # as where a curve's folder was moved
    run.write_json("config.json", to_json(built_on))
    moved = replace(built_on, planner=PlannerConfig(source="/moved"), run=replace(SAVED.run, resume=True))
    check_resume(run, moved)
    run.write_json("config.json", to_json(replace(SAVED, planner=PlannerConfig(source=tmp_path))))  # it is still there
    with pytest.raises(RunDirectoryError, match=r"started with another planner.source: it cannot be resumed"):
        check_resume(run, moved)


def test_checkpoints_without_options_raise_errors(tmp_path):
    check_resume(RunDirectory(tmp_path), SAVED)
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(RunDirectoryError, match="holds checkpoints but no config.json"):
        check_resume(RunDirectory(tmp_path), SAVED)


def test_other_data_and_versions_are_refused(run, caplog):
    content = run.read_json("config.json")
    check_data(run, content)
    with pytest.raises(RunDirectoryError, match=r"started with other demonstrations .* \(5 steps then, 6 now\)"):
        check_data(run, content | {"data": {"steps": 6, "sha256": "b"}})
    run.write_json("config.json", content | {"task_definition": {"control_hz": 20.0, "robot": [0]}})
    again = {"task_definition": {"control_hz": 40.0, "robot": [0], "new": 1}}  # converted again with another rate
    with pytest.raises(RunDirectoryError, match=r"no/longer/there described its columns differently \(control_hz\)"):
        check_data(run, content | again)
    with pytest.raises(RunDirectoryError, match="started with torchrl_koap .*, this is 9"):
        check_data(run, content | {"versions": content["versions"] | {"torchrl_koap": "9"}})
    check_data(run, content | {"versions": content["versions"] | {"torch": "9"}})  # a warning is enough


def test_code_that_changed_in_a_checkout_is_told(run, caplog, monkeypatch):
    content = run.read_json("config.json")
    monkeypatch.setattr(logger, "propagate", True)
    check_data(run, content)
    assert not caplog.text
    check_data(run, content | {"versions": content["versions"] | {"code": "f00"}})
    assert f"started with code {content['versions']['code']} (now f00): its results may differ" in caplog.text
