# This source code is licensed under the MIT license found in the LICENSE file.
"""Planners and cells of a curve: labels reach no planner, results that cannot be read are made again or named."""

from __future__ import annotations

import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies import cells
from torchrl_koap.studies.cells import Cell, cell_row, do_cell, do_planner, is_done, is_trained, planner_folder
from torchrl_koap.studies.table import CELL_COLUMNS
from torchrl_koap.tasks import get_task
from torchrl_koap.training import on_disk
from torchrl_koap.training.datasets import load_demonstrations

CELL = Cell("linear", 0.25, 1.0, 0)
ROW = {"task": "avoiding", "label_unit": "trajectory"}


def settings_of(demonstrations):
    return {"task": "avoiding", "dataset": str(demonstrations), "steps": 3, "controller_steps": 3}


@pytest.fixture(scope="module")
def planner(tmp_path_factory, demonstrations):
    folder = tmp_path_factory.mktemp("curve") / "planner-1"
    do_planner(folder=str(folder), observations=1.0, settings=settings_of(demonstrations))
    return folder


def do(root: Path, planner: Path, demonstrations, cell=CELL):
    do_cell(
        folder=str(root / cell.folder),
        cell=vars(cell),
        planner=str(planner),
        settings=settings_of(demonstrations),
        evaluation={"episodes": 1, "threads": 1},
    )


@pytest.fixture(scope="module")
def finished(planner, demonstrations):
    do(planner.parent, planner, demonstrations)
    return planner.parent


@pytest.fixture
def root(finished, tmp_path):
    shutil.copytree(finished / "cells", tmp_path / "cells")
    return tmp_path


def test_cells_have_folders_of_their_own():
    fractions = (0.01, 0.25, 1.0, 1 / 3, 0.3333333, 1e-5, 1e-7)
    cells = [Cell(method, fraction, 1.0, 0) for method in ("koap", "dp") for fraction in fractions]
    assert len({cell.folder for cell in cells}) == len(cells)
    assert Cell("koap", 0.01, 1.0, 2).folder == "cells/koap-0.01-1-seed2"
    assert Cell("koap", 0.01, 0.5, 2).planner == planner_folder(0.5) == "planner-0.5"
    assert Cell("dp", 0.01, 1.0, 2).planner is None and Cell("vpt", 0.01, 1.0, 2).planner is None


def test_every_training_seed_meets_noise_of_its_own(monkeypatch, tmp_path):
    asked = []

    def note(path, config):
        asked.append((config.seed, config.episodes))
        return {"episodes": 2, "success_rate": 0.5}

    monkeypatch.setattr(cells, "train", lambda config: None)
    monkeypatch.setattr(cells, "evaluate", note)
    monkeypatch.setattr(RunDirectory, "read_entry", lambda *names: {})
    for cell in (CELL, replace(CELL, seed=1), replace(CELL, seed=2), replace(CELL, method="dd", seed=2)):
        folder = tmp_path / cell.folder
        do_cell(folder=str(folder), cell=vars(cell), planner=None, settings={}, evaluation={"episodes": 2})
    assert asked == [(EvalConfig.seed, 2), (1100, 2), (2100, 2), (2100, 2)]


def test_no_action_reaches_a_planner(planner, demonstrations, tmp_path, monkeypatch):
    """Neither actions nor commands nor which steps have one."""
    task = get_task("avoiding")
    data = load_demonstrations(str(demonstrations), task)
    data["action"] = torch.full_like(data["action"], 1e9)
    data["observation"][:, task.observation[task.command]] = 1e9
    data["next", "observation"][:, task.observation[task.command]] = 1e9
    monkeypatch.setattr(on_disk, "load_demonstrations", lambda *arguments, **options: data)
    do_planner(folder=str(tmp_path / "run"), observations=1.0, settings=settings_of(demonstrations))
    name = "planner.safetensors"
    assert (tmp_path / "run" / name).read_bytes() == (planner / name).read_bytes()
    assert is_trained(tmp_path / "run")


def test_a_planner_sees_the_share_of_the_trajectories_that_it_is_told(planner, demonstrations, tmp_path, monkeypatch):
    seen = []
    learn = on_disk.learn_planner
    monkeypatch.setattr(on_disk, "learn_planner", lambda *rest, **more: seen.append(rest[2]) or learn(*rest, **more))
    do_planner(folder=str(tmp_path / "run"), observations=0.5, settings=settings_of(demonstrations))
    (data,) = seen
    assert len(data["episode"].unique()) == 4
    assert data["action"].isnan().all() and not data["has_action"].any()
    name = "planner.safetensors"
    assert (tmp_path / "run" / name).read_bytes() != (planner / name).read_bytes()


def test_a_planner_without_its_weights_or_its_mark_is_not_trained(planner, tmp_path):
    assert is_trained(planner) and not is_trained(tmp_path / "none")
    for name in ("planner.safetensors", "cell.json"):
        folder = tmp_path / name
        shutil.copytree(planner, folder)
        (folder / name).unlink()
        assert not is_trained(folder)
    shutil.copytree(planner, tmp_path / "cut")
    os.truncate(tmp_path / "cut" / "cell.json", 5)
    assert not is_trained(tmp_path / "cut")


def test_a_row_says_what_a_cell_found(finished):
    row = cell_row(finished, CELL, **ROW)
    run = RunDirectory(finished / CELL.folder)
    result, summary = run.read_json("eval.json"), run.read_json("summary.json")
    assert row["status"] == "done" and is_done(run.path) and set(row) <= set(CELL_COLUMNS)
    assert (row["method"], row["fraction"], row["observations"], row["seed"]) == ("linear", 0.25, 1.0, 0)
    assert row["episodes"] == len(result["episode"]) == 1
    assert row["successes"] == sum(episode["outcome"] == "success" for episode in result["episode"])
    assert row["mean_steps"] == result["episode"][0]["steps"]
    assert row["labelled_units"] == row["trajectories_touched"] == 2
    assert row["labelled_transitions"] == summary["labels"]["labelled_transitions"] > 0
    assert row["action_error"] == summary["action_error_mm"]["controller"] and math.isfinite(row["action_error"])


def test_a_cell_that_is_not_done_is_missing_or_failed(tmp_path):
    assert not is_done(tmp_path / CELL.folder)
    assert cell_row(tmp_path, CELL, **ROW)["status"] == "missing"
    row = cell_row(tmp_path, CELL, **ROW, reason="no memory")
    assert (row["status"], row["reason"]) == ("failed", "no memory")
    (tmp_path / "cells").mkdir()
    (tmp_path / CELL.folder).write_text("a file in its place")
    assert not is_done(tmp_path / CELL.folder)
    assert cell_row(tmp_path, CELL, **ROW, reason="in the way")["reason"] == "in the way"


DAMAGES = {
    "truncated": lambda file: os.truncate(file, file.stat().st_size // 2),
    "empty": lambda file: os.truncate(file, 0),
    "another": lambda file: file.write_text("{}"),
    "a list": lambda file: file.write_text("[1, 2]"),
    "null": lambda file: file.write_text(json.dumps(dict.fromkeys(json.loads(file.read_text())))),
    "binary": lambda file: file.write_bytes(b"\xff\xfe\x00" * 30),
    "gone": lambda file: file.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["cell.json", "summary.json", "eval.json"])
def test_results_that_cannot_be_read_are_named_and_not_done(name, damage, root):
    DAMAGES[damage](root / CELL.folder / name)
    assert not is_done(root / CELL.folder)
    row = cell_row(root, CELL, **ROW)
    if (name, damage) == ("cell.json", "gone"):
        assert row["status"] == "missing"
    else:
        assert row["status"] == "failed" and CELL.folder in row["reason"]
    assert cell_row(root, CELL, **ROW, reason="tried again")["reason"] == "tried again"


@pytest.mark.parametrize("change", [{"episodes": 2}, {"success_rate": 1.0}])
def test_an_evaluation_of_somebody_else_is_named_and_not_done(change, root):
    """`koap eval` in the folder of a cell must not slip into the curve."""
    file = root / CELL.folder / "eval.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    assert not is_done(root / CELL.folder)
    assert "eval.json is another evaluation than the curve's" in cell_row(root, CELL, **ROW)["reason"]


def test_a_cell_of_before_that_kept_no_number_of_episodes_is_done(root):
    file = root / CELL.folder / "cell.json"
    content = json.loads(file.read_text())
    assert content.pop("episodes") == 1
    file.write_text(json.dumps(content))
    assert is_done(root / CELL.folder)


@pytest.mark.parametrize("name", ["cell.json", "summary.json", "eval.json"])
def test_a_damaged_cell_is_made_again_without_being_trained_again(name, root, planner, demonstrations):
    before = cell_row(root, CELL, **ROW)
    weights = (root / CELL.folder / "controller.safetensors").stat().st_mtime_ns
    edit = json.loads((root / CELL.folder / "config.json").read_text()) | {"out": str(root / CELL.folder)}
    (root / CELL.folder / "config.json").write_text(json.dumps(edit))
    DAMAGES["truncated"](root / CELL.folder / name)
    do(root, planner, demonstrations)
    after = cell_row(root, CELL, **ROW)
    clock = ("train_seconds", "eval_seconds")
    assert {key: after[key] for key in after if key not in clock} == {
        key: before[key] for key in before if key not in clock
    }
    if name != "summary.json":
        assert (root / CELL.folder / "controller.safetensors").stat().st_mtime_ns == weights


def test_a_cell_with_other_settings_is_not_continued(root, planner, demonstrations):
    (root / CELL.folder / "cell.json").unlink()
    (root / CELL.folder / "summary.json").unlink()
    other = {**settings_of(demonstrations), "controller_steps": 7}
    with pytest.raises(RunDirectoryError, match="was started with another controller.steps"):
        do_cell(
            folder=str(root / CELL.folder),
            cell=vars(CELL),
            planner=str(planner),
            settings=other,
            evaluation={"episodes": 1},
        )
    assert cell_row(root, CELL, **ROW)["status"] == "missing"
