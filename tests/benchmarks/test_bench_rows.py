# This source code is licensed under the MIT license found in the LICENSE file.
"""Committed cells as tables: averages over levels with an honest interval, and answers of decoders to noise."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.studies.table import write_cells

LEVELS = (0.02, 0.05, 0.1, 0.25, 0.5)


@pytest.fixture
def rows(benchmark_script, monkeypatch, tmp_path):
    module = benchmark_script("bench_rows")
    monkeypatch.setattr(module, "CELLS", tmp_path)
    return module


def cell(method, fraction, successes, seconds=30.0):
    done = {"task": "avoiding", "observations": 1.0, "seed": 0, "label_unit": "window", "status": "done"}
    times = {"train_seconds": seconds, "eval_seconds": 30.0}
    return done | times | {"method": method, "fraction": fraction, "episodes": 60, "successes": successes}


def test_averages_have_the_interval_of_a_single_cell_and_need_all_levels(rows, tmp_path):
    cells = [cell("koap", level, count) for level, count in zip(LEVELS, (60, 54, 48, 54, 54), strict=True)]
    write_cells(tmp_path / "made.csv", [*cells, cell("pca", 0.02, 30)])
    head, _, line = rows.bench_means("made").splitlines()
    assert "`koap`" in head and "pca" not in head
    assert "| 90.0 % (80-95) |" in line  # of 60 rollouts; of 300 it would be 86-93
    assert line.endswith("| 93.8 % |")
    assert rows.bench_cost("made") == "0.1 hours (1.0 minutes a cell)"


def test_another_method_is_counted_against_the_papers_koap(rows, tmp_path):
    cells = [cell("koap", 0.02, 60), cell("pca", 0.02, 60), cell("pca", 0.05, 40), cell("koap", 0.05, 60)]
    write_cells(tmp_path / "made.csv", cells)
    assert rows.bench_sentence("made") == "2 of 2"
    assert rows.bench_sentence("made", "pca") == "1 of 2"  # the paper's KOAP has 78.0 and 98.05 %


def test_a_task_is_counted_by_the_method_it_is_trained_with(rows, tmp_path):
    here = {"task": "stacking_unobserved_joints"}
    cells = [cell("koap", 0.01, 60) | here, cell("koap_posture", 0.01, 6) | here, cell("koap_posture", 0.02, 30) | here]
    write_cells(tmp_path / "made.csv", [cell("koap", 0.02, 60), cell("koap_posture", 0.02, 60), *cells])
    assert rows.bench_defaults("made") == "2 of 3"  # koap_posture has 10 % in one, the paper's KOAP 27.2 %


def test_a_cell_with_more_seeds_is_told_by_its_first(rows, tmp_path):
    cells = [
        cell("dp", 0.02, 20) | {"seed": 1},
        cell("dp", 0.02, 30),
        cell("dp", 0.5, 45),
        cell("dp", 0.5, 9) | {"seed": 1},
    ]
    write_cells(tmp_path / "made.csv", cells)
    assert rows.first_successes("made", "avoiding", "dp") == "30 of 60"
    assert rows.first_successes("made", "avoiding", "dp", most_labels=True) == "45 of 60"


def test_longer_training_stands_beside_the_cell_of_its_seed_and_the_tasks_method(rows, tmp_path):
    short, longer = ({"controller_updates": updates} for updates in (5000, 15000))
    others = [cell("dp", 0.02, 10) | short | {"seed": 1}, cell("koap", 0.02, 60), cell("koap", 0.02, 30) | {"seed": 1}]
    write_cells(tmp_path / "made.csv", [*others, cell("dp", 0.02, 30) | short])
    write_cells(tmp_path / "longer.csv", [cell("dp", 0.02, 45) | longer])
    *_, line = rows.longer_table("made", "longer").splitlines()
    assert "| 50.0 % (38-62) of 60 | 5,000 | 75.0 % (63-84) of 60 | 15,000 | 75.0 % (67-82) of 120 | `koap` |" in line


def test_the_whole_table_costs_what_its_measured_cells_do(rows, monkeypatch, tmp_path):
    preset = SimpleNamespace(methods="koap,dp", tasks=("avoiding",), levels=(1, 2, 3), first_seed_only=(3,))
    monkeypatch.setattr(rows, "PRESETS", {"table 1": preset})
    made = {"planners": [{"seconds": "600"}, {"seconds": "120"}], "demonstrations": [{"seconds": "360"}]}
    monkeypatch.setattr(rows, "read_rows", lambda name, part: made[part])
    write_cells(tmp_path / "here.csv", [cell("koap", 0.02, 60, seconds=10.0), cell("koap", 0.05, 60, seconds=30.0)])
    write_cells(tmp_path / "there.csv", [cell("koap", 0.02, 60, seconds=900.0), cell("dp", 0.02, 60, seconds=270.0)])
    # 7 cells of koap at 50 s and 7 of dp at 300 s, 1,080 s before them, two at a time
    told = rows.protocol_cost("here", "there")
    assert (
        told.startswith("0.5 hours on two cores: 14 cells of 175 seconds") and "12 minutes" in told and "6 for" in told
    )


def test_cells_of_another_comparison_stand_beside(rows, tmp_path):
    write_cells(tmp_path / "first.csv", [cell("koap", 0.02, 60), cell("koap", 0.05, 30), cell("pca", 0.02, 0)])
    write_cells(tmp_path / "made.csv", [cell("relabel", 0.02, 30)])
    head, _, line = rows.bench_table("made", "first", ("koap",)).splitlines()
    assert "koap" in head and "pca" not in head and "100.0 (94-100)" in line and "50.0 (38-62)" in line  # level 1 alone


def test_a_study_of_observations_has_a_row_per_share(rows, tmp_path):
    few = cell("koap", 0.01, 30) | {"observations": 0.1}
    write_cells(tmp_path / "made.csv", [cell("koap", 0.01, 60), cell("pca", 0.01, 15), few])
    head, _, first, second = rows.observation_table("made").splitlines()
    assert first.startswith("| 10 % | 50.0 %") and first.endswith("| not run |") and "`pca`" in head
    assert second.startswith("| 100 % | 100.0 %")


def test_replaced_parts_of_a_controller_are_a_table(rows, monkeypatch, tmp_path):
    kept = {"gripper": "planned", "motion": "decoded", "pull": "0.0", "n": "60", "successes": "3"}
    pulled = kept | {"motion": "posture", "pull": "0.3", "successes": "30"}
    monkeypatch.setattr(rows, "read_rows", lambda name: [kept, pulled])
    _, _, first, second = rows.posture_table().splitlines()
    assert "| none |" in first and "| 0.3 | 50.0 % (37.7-62.3) of 60 |" in second


def test_noise_of_the_frames_is_told_as_a_share_of_the_actions(benchmark_script, monkeypatch, tmp_path):
    script = benchmark_script("noise_answers")
    steps = torch.arange(120)
    state = torch.stack([0.01 * (steps % 60), torch.zeros(120), torch.zeros(120), torch.zeros(120)], 1).double()
    action = torch.full((120, 2), 0.01).double()
    data = TensorDict({"state": state, "action": action, "episode": steps // 60}, [120])

    class Difference(torch.nn.Module):
        """Reads the first coordinate's next step as both actions."""

        num_past = 0

        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Buffer(torch.ones(1))

        def forward(self, windows):
            ahead = windows["state"][..., 1:, :1] - windows["state"][..., :-1, :1]
            return windows.set("action", torch.cat([ahead, ahead[..., -1:, :]], -2).expand(*[-1] * (ahead.ndim - 1), 2))

    planner = SimpleNamespace(history=2, plan=lambda seen, generator: seen[:, -1:] + torch.tensor([0.012, 0.0, 0, 0]))
    task = SimpleNamespace(name="made", action_columns=lambda: [0, 1], action_names=("x", "y"))
    method = SimpleNamespace(name="koap")
    run = SimpleNamespace(task=task, method=method, planner=planner, columns=(0, 1, 2, 3), controller=Difference())
    monkeypatch.setattr(script, "load_run", lambda path: run)
    monkeypatch.setattr(script, "load_demonstrations", lambda folder, task: data)
    table = tmp_path / "table.csv"
    words = ["noise_answers.py", "made", "--dataset", "none", "--noise", "0", "1", "--table", str(table)]
    monkeypatch.setattr("sys.argv", words)
    script.main()
    script.main()
    with table.open(newline="") as file:
        quiet, noisy = csv.DictReader(file)
    assert float(quiet["share"]) < 1e-3 and 0.08 < float(noisy["share"]) < 0.2  # sqrt(2) mm of a step of 10 mm
    assert noisy["worst"] in ("x", "y")
    assert float(quiet["plan_error_mm"]) == pytest.approx(1.41, abs=0.01)  # 2 mm in one of two columns
