# This source code is licensed under the MIT license found in the LICENSE file.
"""Loggers: what is missing is named before any work, what is there writes into the run directory."""

from __future__ import annotations

import importlib.util

import pytest
from late_files import wait_for
from PIL import Image

from torchrl_koap.training.loggers import LOGGERS, check_logger, close_logger, log_evaluation, make_logger


@pytest.mark.parametrize("name", [name for name, (module, _) in LOGGERS.items() if module])
def test_a_missing_package_names_the_extra(name, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda *args: None)
    with pytest.raises(ValueError, match=rf"--logger {name} needs an extra: pip install 'torchrl_koap\[{name}\]'"):
        check_logger(name)


def test_unknown_names_suggest_the_nearest():
    with pytest.raises(ValueError, match="unknown logger 'tensorbord'; did you mean 'tensorboard'"):
        check_logger("tensorbord")


def test_metrics_csv_needs_no_logger(tmp_path):
    assert make_logger("csv", tmp_path) is None
    close_logger(None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["tensorboard", "mlflow"])
def test_scalars_arrive_in_the_run_directory(name, tmp_path, monkeypatch):
    pytest.importorskip(name)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    for step in (1, 2):  # a second training in the same process begins a run of its own
        logger = make_logger(name, tmp_path / "run")
        logger.log_scalar("planner/loss_planner", 0.5, step=step)
        close_logger(logger)
    files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) > 50


@pytest.mark.parametrize("name", ["wandb", "tensorboard", "mlflow"])
def test_figures_and_films_of_an_evaluation_arrive_in_the_run_directory(name, tmp_path, monkeypatch):
    pytest.importorskip(name)
    for variable in ("WANDB_MODE", "WANDB_DIR", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    run.mkdir()
    pictures = [Image.new("RGB", (8, 6), color) for color in ("red", "blue")]
    pictures[0].save(run / "rollouts.gif", save_all=True, append_images=pictures[1:])
    film = (run / "rollouts.gif").read_bytes()
    logger = make_logger(name, run)
    figures = {"success_rate": 0.625, "episodes": 8, "kind": "closed loop", "entropy": float("nan")}
    log_evaluation(logger, figures, [run / "rollouts.gif"])
    close_logger(logger)
    assert wait_for(b"eval/success_rate", tmp_path)
    written = [path for path in tmp_path.rglob("*") if path.is_file() and path != run / "rollouts.gif"]
    assert any(film in path.read_bytes() for path in written)
    assert not any(b"eval/entropy" in path.read_bytes() for path in written)
    assert all(run in path.parents for path in written), written
