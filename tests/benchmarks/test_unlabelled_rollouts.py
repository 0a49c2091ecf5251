# This source code is licensed under the MIT license found in the LICENSE file.
"""Controllers that follow demonstrations in a regime: who reads the plan arrives, who stands still does not."""

from __future__ import annotations

import csv
import sys

import pytest
import torch
from tensordict import TensorDict
from tiny_runs import koap
from torch import nn

from torchrl_koap.tasks import get_task


@pytest.fixture(scope="module")
def script(benchmark_script):
    return benchmark_script("unlabelled_rollouts")


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demonstrations") / "demos"
    assert koap("demos", "--out", folder, "--episodes", 6, "--threads", 1, "--quiet") == 0
    return folder


class Next(nn.Module):
    """Commands a multiple of the step that is planned some frames ahead, when the arm will have answered."""

    num_past = 1

    def __init__(self, gain):
        super().__init__()
        self.gain = gain

    def forward(self, window):
        state = window["state"]
        action = torch.zeros_like(state)
        action[:, 1] = self.gain * (state[:, 4] - state[:, 3])
        return TensorDict({"action": action}, window.batch_size)


def shown(script, demonstrations, regime):
    data, _ = script.load_positions(str(demonstrations), 100)
    sensor = script.RegimeSensor(data, regime)
    seen = data.copy().set("state", sensor.noisy(sensor.recorded)).set("observation", data["state"])
    return sensor, seen.set("episode", torch.unique(data["episode"], return_inverse=True)[1])


def test_who_follows_arrives_and_who_stands_still_does_not(script, demonstrations):
    sensor, seen = shown(script, demonstrations, "plain")
    episodes, task = torch.arange(6), get_task("avoiding")
    moved, stood = (script.follow(Next(gain), sensor, seen, task, episodes, 0.0, 0) for gain in (1.0, 0.0))
    assert moved["successes"] >= 4 and moved["successes"] + moved["collisions"] <= 6
    assert (stood["successes"], stood["collisions"]) == (0, 0)
    assert moved["distance_mm"] < 40 < stood["distance_mm"]


def test_noise_reaches_the_controller(script, demonstrations):
    task, episodes = get_task("avoiding"), torch.arange(2)
    results = []
    for regime in ("plain", "noise"):
        sensor, seen = shown(script, demonstrations, regime)
        results.append(script.follow(Next(1.0), sensor, seen, task, episodes, 0.0, 0)["distance_mm"])
    assert results[0] < results[1]


def test_noise_is_that_of_the_seed_whatever_ran_before(script, demonstrations):
    task, episodes = get_task("avoiding"), torch.arange(2)
    sensor, seen = shown(script, demonstrations, "noise")
    first, second, other = (script.follow(Next(1.0), sensor, seen, task, episodes, 0.8, seed) for seed in (3, 3, 4))
    assert first == second != other


def test_rows_are_not_run_again(script, demonstrations, tmp_path, monkeypatch):
    table = tmp_path / "rows.csv"
    arguments = [
        *("--dataset", str(demonstrations), "--regimes", "wide_64", "--methods", "linear_steps", "--labels", "1"),
        *("--seeds", "0", "--judged", "2", "--table", str(table)),
    ]
    monkeypatch.setattr(sys, "argv", ["unlabelled_rollouts.py", *arguments])
    script.main()
    with table.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["regime"], row["method"], row["n"]) == ("wide_64", "linear_steps", "2")
    monkeypatch.setattr(script, "follow", None)
    script.main()
    assert len(table.read_text().splitlines()) == 2


def test_errors_are_those_that_the_other_table_would_hold(script, demonstrations, tmp_path, monkeypatch):
    study, tables = (
        sys.modules["unlabelled_data"],
        [tmp_path / name for name in ("rollouts.csv", "both.csv", "own.csv")],
    )
    common = ["--dataset", str(demonstrations), "--regimes", "noise", "--methods", "linear_steps", "--labels", "1", "2"]
    common += ["--seeds", "1"]
    both = [*common, "--judged", "2", "--table", str(tables[0]), "--errors", str(tables[1])]
    monkeypatch.setattr(study, "JUDGED", 4)
    monkeypatch.setattr(sys, "argv", ["unlabelled_rollouts.py", *both])
    script.main()
    monkeypatch.setattr(sys, "argv", ["unlabelled_data.py", *common, "--trajectories", "6", "--table", str(tables[2])])
    study.main()
    assert tables[1].read_text() == tables[2].read_text()
    assert [len(table.read_text().splitlines()) for table in tables] == [3, 3, 3]
    tables[0].unlink()  # one of the two is missing: that alone is done again
    monkeypatch.setattr(sys, "argv", ["unlabelled_rollouts.py", *both])
    script.main()
    assert [len(table.read_text().splitlines()) for table in tables] == [3, 3, 3]


def test_too_few_demonstrations_are_named(script, demonstrations, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["unlabelled_rollouts.py", "--dataset", str(demonstrations)])
    with pytest.raises(SystemExit):
        script.main()
    assert "fewer demonstrations than are judged and labelled" in capsys.readouterr().err


def test_other_tasks_are_refused_before_their_data_are_read(script, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "aligning"
    assert koap("demos", "--out", folder, "--task", "aligning", "--episodes", 2, "--threads", 1, "--quiet") == 0
    monkeypatch.setattr(script, "load_positions", None)
    monkeypatch.setattr(sys, "argv", ["unlabelled_rollouts.py", "--dataset", str(folder)])
    with pytest.raises(SystemExit):
        script.main()
    assert "holds demonstrations of aligning" in capsys.readouterr().err


def test_labels_from_play_are_of_no_demonstration(script, demonstrations):
    study = sys.modules["unlabelled_data"]
    data, _ = script.load_positions(str(demonstrations), 100)
    both = study.add_play(data, str(demonstrations))
    assert len(both["episode"].unique()) == 6 + study.PLAYED
    torch.testing.assert_close(both["state"][: len(data)], data["state"])
    full, _ = script.as_own_data(both)
    for seed in range(3):
        numbers = script.shuffled_trajectories(full, seed, study.PLAYED)
        assert numbers[: study.PLAYED].min() >= 6 > numbers[study.PLAYED :].max()
        assert numbers.unique().numel() == 6 + study.PLAYED
        labelled = study.with_labels(full, numbers[:2])
        known = labelled["episode"][labelled["has_action"].squeeze(-1)].unique()
        assert known.tolist() == sorted(numbers[:2].tolist())


def test_rollouts_of_all_seeds_are_counted_together(benchmark_script, monkeypatch):
    rows = benchmark_script("unlabelled_rows")
    found = [{"regime": "plain", "method": "koap", "labels": "2", "seed": str(seed), "n": "60"} for seed in (0, 1)]
    made = [row | {"successes": str(30 + 12 * int(row["seed"]))} for row in found]
    monkeypatch.setattr(rows, "read_rows", lambda name, **wanted: made)
    assert rows.followed("plain", 2, "koap") == "60 % (51-68) of 120"
    assert rows.paired_gain([10.0, 10.0, 10.0]) == "+10 % (+10 to +10)"
    assert rows.paired_gain([3.0], unit="points") == "+3 points (1 seeds)" and rows.paired_gain([]) == "not run"
