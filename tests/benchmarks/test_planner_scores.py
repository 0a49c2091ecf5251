# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the study of planner scores: the contents of a row, and rank correlations."""

from functools import partial
from pathlib import Path

import ground_rows
import planner_scores
import torch

from torchrl_koap import fit
from torchrl_koap.data import save_demonstrations


def test_a_row_holds_scores_and_successes_of_a_planner(tmp_path, monkeypatch, capsys):
    states = [torch.randn(30, 4, generator=torch.Generator().manual_seed(i)).cumsum(0).numpy() for i in range(6)]

    def write(folder: Path) -> None:
        save_demonstrations(
            folder, states, [path[1:, :2] - path[:-1, :2] for path in states], control_hz=30, robot=[0, 1]
        )

    ground = planner_scores.Ground(write, "success", (2,), 5, "Toy-v0", 10)
    monkeypatch.setattr(planner_scores, "RESULTS", tmp_path / "planner_scores.csv")
    monkeypatch.setattr(planner_scores, "TRAININGS", (("mlp", 0, 1), ("mlp", 1, 2)))
    monkeypatch.setattr(planner_scores, "fit", partial(fit, controller={"steps": 2}))
    monkeypatch.setattr(planner_scores, "roll", lambda ground, trained, execution, n: {"successes": 3})
    for _ in range(2):  # what is there is not trained again
        planner_scores.study("toy", ground, tmp_path, 0, 5)
    head, first, second = (tmp_path / "planner_scores.csv").read_text().split()
    assert head == "ground,seed,network,octaves,updates,n,plan_score,energy_score,successes"
    assert first.startswith("toy,0,mlp,0,1,5,") and second.startswith("toy,0,mlp,1,2,5,") and first.endswith(",3")
    assert all(float(number) > 0 for number in first.split(",")[6:8])


def test_a_score_that_ranks_planners_like_their_failures_has_rank_correlation_one(monkeypatch):
    keys = ("plan_score", "energy_score", "successes")
    scored = [(0.2, 0.3, 9), (0.3, 0.2, 7), (0.9, 0.1, 1)]
    rows = [{"ground": "toy", "seed": "0", "n": "10", **dict(zip(keys, map(str, row), strict=True))} for row in scored]
    monkeypatch.setattr(ground_rows, "read_rows", lambda name: rows)
    assert ground_rows.rank_correlations().splitlines()[-1] == "| toy | 0 | 3 | 1.00 | -1.00 |"
