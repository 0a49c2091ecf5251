# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the study of unlabelled data: rollouts along demonstrations, noise, rows that are not run again."""

import pytest
import torch
from tensordict import TensorDict
from tiny_runs import koap, read_csv
from torch import nn

from torchrl_koap.tasks import get_task


@pytest.fixture(scope="module")
def script(benchmark_script):
    return benchmark_script("unlabelled")


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
    sensor = script.RegimeSensor(data, script.REGIMES[regime])
    seen = data.copy().set("state", sensor.noisy(sensor.recorded)).set("observation", data["state"])
    return sensor, seen.set("episode", torch.unique(data["episode"], return_inverse=True)[1])


def test_a_controller_that_follows_the_plan_succeeds_and_one_that_stands_still_fails(script, demonstrations):
    sensor, seen = shown(script, demonstrations, "plain")
    episodes, task = torch.arange(6), get_task("avoiding")
    moved, stood = (script.follow(Next(gain), sensor, seen, task, episodes, 0.0, 0) for gain in (1.0, 0.0))
    assert moved["successes"] >= 4 and moved["successes"] + moved["collisions"] <= 6
    assert (stood["successes"], stood["collisions"]) == (0, 0)
    assert moved["distance_mm"] < 40 < stood["distance_mm"]


def test_noise_depends_on_the_seed_alone(script, demonstrations):
    task, episodes = get_task("avoiding"), torch.arange(2)
    sensor, seen = shown(script, demonstrations, "noise")
    first, second, other = (script.follow(Next(1.0), sensor, seen, task, episodes, 0.8, seed) for seed in (3, 3, 4))
    assert first == second != other


def test_only_missing_rows_of_each_table_are_run(script, demonstrations, tmp_path, monkeypatch):
    monkeypatch.setattr(script, "JUDGED", 2)
    asked = {"dataset": demonstrations, "observed": ("wide_64",), "methods": ("linear_steps",), "labels": (1, 2)}
    asked |= {"seeds": (1,), "judged": 2, "folder": tmp_path}
    script.main(**asked)
    errors = (tmp_path / "unlabelled_data.csv").read_text()
    assert len(errors.splitlines()) == 3 and not (tmp_path / "unlabelled_rollouts.csv").exists()
    script.main(**asked, rollouts=True)
    first, _ = read_csv(tmp_path / "unlabelled_rollouts.csv")
    assert (first["regime"], first["method"], first["labels"], first["n"]) == ("wide_64", "linear_steps", "1", "2")
    assert (tmp_path / "unlabelled_data.csv").read_text() == errors
    monkeypatch.setattr(script, "controllers", None)
    script.main(**asked, rollouts=True)
    monkeypatch.undo()
    (tmp_path / "unlabelled_data.csv").unlink()
    monkeypatch.setattr(script, "JUDGED", 2)
    script.main(**asked)  # the same error, whatever else is measured
    assert (tmp_path / "unlabelled_data.csv").read_text() == errors
