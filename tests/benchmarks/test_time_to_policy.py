# This source code is licensed under the MIT license found in the LICENSE file.
"""Success against training time: what is trained, and what a row says."""

import csv
from types import SimpleNamespace

import pytest

from torchrl_koap.tasks import get_task


@pytest.fixture
def study(benchmark_script, monkeypatch):
    script, script.asked, script.rolled = benchmark_script("time_to_policy"), [], []

    def train(config):
        script.asked.append(config)
        return SimpleNamespace(task=get_task(config.task), results={"planner": {"kept_update": 40}})

    def evaluate(run, config):
        script.rolled.append(config)
        return {"rates": {"success": {"rate": 0.75, "episodes": config.episodes}}, "mode_entropy": 0.5}

    monkeypatch.setattr(script, "train", train)
    monkeypatch.setattr(script, "evaluate", evaluate)
    return script


def test_each_number_of_updates_is_trained_and_written_once(study, tmp_path):
    for steps in ((30,), (30, 60)):
        options = {
            "fraction": 0.01,
            "held_out": 0.1,
            "learning_rate": 0.002,
            "folder": tmp_path,
            "results": tmp_path / "t.csv",
        }
        study.main("sorting", tmp_path, steps=steps, **options)
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["updates"], row["successes"], row["n"], row["kept_update"]) for row in rows] == [
        ("30", "135", "180", "40"),
        ("60", "135", "180", "40"),
    ]
    assert {row["network"] for row in rows} == {"mlp"} and {row["held_out"] for row in rows} == {"0.1"}
    assert {row["learning_rate"] for row in rows} == {"0.002"} and study.asked[0].planner.learning_rate == 0.002
    assert [config.rollouts_per_context for config in study.rolled] == [3, 3]
    assert [config.planner.steps for config in study.asked] == [30, 60]
    assert study.asked[-1].labels.unit == "window" and study.asked[-1].planner.steps == 60


def test_tasks_without_contexts_begin_alike(study, tmp_path):
    study.main("avoiding", tmp_path, steps=(30,), count=1, folder=tmp_path, results=tmp_path / "t.csv")
    assert study.rolled[0].rollouts_per_context == 1 and study.asked[0].labels.count == 1
