# This source code is licensed under the MIT license found in the LICENSE file.
"""Run directories of earlier versions: evaluated and resumed as they lie there."""

from __future__ import annotations

import csv
import json
import shutil

import pytest
from tiny_runs import koap

from torchrl_koap.evaluation import load_run
from torchrl_koap.runs.run_directory import RunDirectory

# every run had these columns, whatever was logged
COLUMNS = (
    *("phase", "step", "loss_planner", "loss_reconstruction", "loss_koopman", "loss_kl", "loss_dynamics"),
    *("loss_action", "loss_policy", "learning_rate", "iterations_per_second"),
)


@pytest.fixture
def older_run(trained_run, tmp_path):
    """The run as the version before plugins, locks, checksums and free log columns left it."""
    folder = tmp_path / "run"
    shutil.copytree(trained_run, folder, ignore=shutil.ignore_patterns(".lock", "digests.json"))
    config = json.loads((folder / "config.json").read_text())
    for name in ("plugins", "data", "force_data"):
        del config[name]
    (folder / "config.json").write_text(json.dumps(config))
    rows = RunDirectory(folder).read_metrics()
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="")
        writer.writeheader()
        writer.writerows(rows)
    return folder


def test_it_is_loaded_and_evaluated(older_run):
    loaded = load_run(older_run)
    assert (loaded.task.name, loaded.method.name, loaded.columns) == ("avoiding", "koap", (0, 1))
    assert loaded.budget.count == 2
    assert koap("eval", older_run, "--episodes", 1, "--threads", 1, "--no-report") == 0
    assert json.loads((older_run / "eval.json").read_text())["episodes"] == 1


def test_it_goes_on_and_ends_with_the_same_weights(older_run, trained_run):
    (older_run / "controller.safetensors").unlink()
    shutil.rmtree(older_run / "checkpoints")
    assert koap("train", "--out", older_run, "--resume") == 0
    name = "controller.safetensors"
    assert (older_run / name).read_bytes() == (trained_run / name).read_bytes()
    rows = RunDirectory(older_run).read_metrics()
    assert tuple(rows[0]) == COLUMNS and [row["phase"] for row in rows] == ["planner", "controller"]
    assert json.loads((older_run / "config.json").read_text())["plugins"] == []
