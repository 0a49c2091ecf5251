# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the example without ``koap train`` is short, names its parts and runs."""

import runpy
import sys
from pathlib import Path

import torch

EXAMPLE = Path(__file__).parents[2] / "examples" / "train_without_commands.py"


def test_the_example_has_sixty_lines():
    lines = EXAMPLE.read_text().splitlines()
    assert len(lines) <= 60
    for part in (
        "KoopmanInverseDynamics",
        "LabelBudget",
        "make_window_buffer",
        "KOAPLoss",
        "TransformedEnv",
        "Collector",
    ):
        assert part in EXAMPLE.read_text(), part


def test_the_example_runs(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--demonstrations", "4", "--updates", "2"])
    names = runpy.run_path(str(EXAMPLE), run_name="__main__")
    labels, controller, planner, rollouts = capsys.readouterr().out.splitlines()
    assert "transitions have labels" in labels and "loss_koopman" in controller and "loss_planner" in planner
    assert rollouts.startswith("(8, 120): ") and "nan" not in controller + planner
    planner, buffer = names["planner"], names["states"]
    trained_on = torch.cat([buffer.sample()["state"] for _ in range(100)])
    plans = planner.encode(*planner.split_window(trained_on))  # statistics are those of the windows trained on
    spread = plans.square().mean(0).sqrt()  # 1, but for rows at rest
    assert ((spread - 1).abs() < 0.1).all()
