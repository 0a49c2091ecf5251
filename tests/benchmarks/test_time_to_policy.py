# This source code is licensed under the MIT license found in the LICENSE file.
"""Success against training time: what is trained, and what a row says."""

from types import SimpleNamespace

import pytest
from tiny_runs import read_csv

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
    where = {"folder": tmp_path, "results": tmp_path / "t.csv"}
    for steps in ((30,), (30, 60)):
        study.main("sorting", tmp_path, steps=steps, fraction=0.01, held_out=0.1, learning_rate=0.002, **where)
    rows = read_csv(tmp_path / "t.csv")
    assert [(row["updates"], row["successes"], row["n"], row["kept_update"]) for row in rows] == [
        ("30", "135", "180", "40"),
        ("60", "135", "180", "40"),
    ]
    assert {(row["network"], row["held_out"], row["learning_rate"]) for row in rows} == {("mlp", "0.1", "0.002")}
    assert [config.rollouts_per_context for config in study.rolled] == [3, 3]
    planners = [config.planner for config in study.asked]
    assert [(planner.steps, planner.learning_rate) for planner in planners] == [(30, 0.002), (60, 0.002)]
    assert study.asked[-1].labels.unit == "window"
    study.main("avoiding", tmp_path, steps=(30,), count=1, **where)  # its episodes begin alike
    assert study.rolled[-1].rollouts_per_context == 1 and study.asked[-1].labels.count == 1
