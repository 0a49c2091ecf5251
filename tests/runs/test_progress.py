# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that progress bars never stop the work, and that loggers write into the run directory."""

import importlib.util
import io
import os
import struct
import sys

import pytest
from late_files import wait_for

from torchrl_koap.runs.progress import (
    check_logger,
    log_scores,
    open_logger,
    progress_bar,
    show_losses,
    without_progress_bars,
)


class Full(io.StringIO):
    def __init__(self, room=0):
        super().__init__()
        self.room = room

    def write(self, text):
        self.room -= 1
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return super().write(text)

    def flush(self):
        if self.room < 0:
            raise OSError(28, "No space left on device")


def counted(steps=5):
    """What a bar has counted that is moved, given a text and closed."""
    with progress_bar(steps, "updates", mininterval=0) as bar:
        for _ in range(steps):
            bar.update()
            bar.set_postfix(loss=1.0)
    return bar.n


CLOSED = io.StringIO()
CLOSED.close()


@pytest.mark.parametrize("stream", [Full(0), Full(3), CLOSED, None], ids=["full", "soon full", "closed", "missing"])
def test_the_work_goes_on_where_no_bar_can_be_shown(monkeypatch, stream):
    monkeypatch.setattr(sys, "stderr", stream)
    assert counted() == 5 * (stream is not None)


def test_bars_are_shown_on_stderr_unless_they_are_turned_off(capsys):
    counted()
    assert "5/5" in capsys.readouterr().err
    with without_progress_bars():
        counted()
    assert not capsys.readouterr().err


def test_in_a_file_a_bar_is_lines_not_carriage_returns(monkeypatch, tmp_path):
    log = tmp_path / "log.txt"
    with log.open("w") as file:
        monkeypatch.setattr(sys, "stderr", file)
        with progress_bar(3000, "updates", mininterval=0) as bar:
            show = show_losses(bar)
            for step in range(1, 3001):
                show(step, {"loss_planner": 0.25})
        with progress_bar(2, "gone", leave=False) as bar:
            bar.update(2)
    first, last, gone = log.read_bytes().decode().splitlines()
    assert first.startswith("updates:   0%") and "3000/3000" in last and last.endswith("planner=0.25]")
    assert gone.startswith("gone:   0%")
    assert "\r" not in log.read_bytes().decode()


def test_a_bar_is_no_wider_than_the_terminal(monkeypatch):
    fcntl, pty, termios = (pytest.importorskip(name) for name in ("fcntl", "pty", "termios"))
    above, below = pty.openpty()
    fcntl.ioctl(below, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    with os.fdopen(above, "rb"), open(below, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        with progress_bar(9, "controller", mininterval=0.0) as bar:
            bar.set_postfix(dict.fromkeys(("reconstruction", "koopman", "action"), "0.1234"))
            drawn = ""
            while "reconstruction" not in drawn:  # the terminal may hand over a part
                drawn += os.read(above, 9999).decode()
    assert max(map(len, drawn.split("\r"))) <= 80  # a longer bar would start a new line at every update


def test_a_bar_of_a_terminal_is_drawn_over_itself(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    counted()
    assert stream.getvalue().count("\r") > 5 and stream.getvalue().count("\n") == 1


@pytest.mark.parametrize("name", ["wandb", "tensorboard"])
def test_a_missing_package_names_the_extra(name, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda *args: None)
    with pytest.raises(ValueError, match=rf"--logger {name} needs an extra: pip install 'torchrl_koap\[{name}\]'"):
        check_logger(name)


def test_unknown_loggers_suggest_the_nearest():
    with pytest.raises(ValueError, match="unknown logger 'tensorbord'; did you mean 'tensorboard'"):
        check_logger("tensorbord")


def test_metrics_csv_needs_no_logger(tmp_path):
    with open_logger("csv", tmp_path, {}) as logger:
        assert logger is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["wandb", "tensorboard"])
def test_losses_and_scores_arrive_in_the_run_directory(name, tmp_path, monkeypatch):
    pytest.importorskip(name)
    for variable in ("WANDB_MODE", "WANDB_DIR"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    with open_logger(name, run, {"method": "koap", "planner": {"steps": 3217, "source": None}}) as logger:
        logger.log_scalar("planner/loss_planner", 0.5, step=1)
        log_scores(logger, {"success_rate": 0.625, "episodes": 8, "kind": "closed loop", "entropy": float("nan")})
    for text in (b"eval/success_rate", b"planner.steps"):
        wait_for(text, tmp_path)
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not any(b"eval/entropy" in path.read_bytes() for path in written)
    assert all(run in path.parents for path in written), written
