# This source code is licensed under the MIT license found in the LICENSE file.
"""Bars: shown, not shown, and never in the way of the work."""

from __future__ import annotations

import io
import sys

import pytest

from torchrl_koap.training.progress import progress_bar, without_progress_bars


class Full(io.StringIO):
    """A device without room, which takes ``room`` writes."""

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


@pytest.mark.parametrize("room", [0, 3])
def test_a_full_device_gets_no_bar_and_the_work_goes_on(monkeypatch, room):
    monkeypatch.setattr(sys, "stderr", Full(room))
    assert counted() == 5


def test_a_closed_or_missing_terminal(monkeypatch):
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(sys, "stderr", closed)
    assert counted() == 5
    monkeypatch.setattr(sys, "stderr", None)
    counted()


def test_bars_are_shown_on_stderr_unless_they_are_turned_off(capsys):
    counted()
    assert "5/5" in capsys.readouterr().err
    with without_progress_bars():
        counted()
    assert not capsys.readouterr().err
