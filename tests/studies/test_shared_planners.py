# This source code is licensed under the MIT license found in the LICENSE file.
"""Which planner a cell of a curve shares, what it is trained on, and what it is told; nothing is trained here."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_runs import TINY, koap

from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.studies import label_efficiency
from torchrl_koap.studies.label_efficiency import CurveConfig, run_curve


@pytest.fixture
def jobs(monkeypatch, demonstrations, tmp_path):
    """Calls a curve on the demonstrations and returns what would be done, by name."""

    def asked(**options):
        found = {}

        def nothing(jobs, **how):
            found.update({job.name: job for job in jobs})
            yield from ()

        monkeypatch.setattr(label_efficiency, "launch", nothing)
        run_curve(CurveConfig(tmp_path / "curve", dataset=str(demonstrations), fractions="0.5", seeds=2, **options))
        return found

    return asked


def test_cells_of_all_seeds_share_a_planner_that_knows_no_seed(jobs):
    found = jobs(methods="koap,dp", denoiser="mlp", denoiser_width=64)
    assert [name for name in found if not name.startswith("cells")] == ["planner-1"]
    planner = found["planner-1"].arguments["settings"]
    assert planner["denoiser_width"] == 64 and "seed" not in planner
    cells = {name: job.arguments for name, job in found.items() if name.startswith("cells")}
    assert {Path(cell["planner"]).name for name, cell in cells.items() if "koap" in name} == {"planner-1"}
    assert all(cell["planner"] is None for name, cell in cells.items() if "dp" in name)
    assert cells["cells/dp-0.5-1-seed0"]["settings"]["denoiser_width"] == 64


def test_a_planner_per_seed(jobs):
    found = jobs(methods="koap", planner_seeds=2)
    assert found["planner-1-seed1"].arguments["settings"]["seed"] == 1
    assert found["cells/koap-0.5-1-seed1"].needs == ("planner-1-seed1",)


def test_a_planner_that_does_not_grow_with_the_controllers_data(jobs):
    found = jobs(methods="koap", observations="0.5,1", planner_observations=1.0)
    assert [name for name in found if not name.startswith("cells")] == ["planner-1"]
    assert found["planner-1"].arguments["observations"] == 1.0
    assert found["cells/koap-0.5-0.5-seed0"].needs == ("planner-1",)


def test_koap_paper_is_told_what_was_published(jobs):
    told = jobs(methods="koap_paper,koap")["cells/koap_paper-0.5-1-seed0"].arguments
    assert "controller_state" not in told["settings"]  # the method says it
    assert told["evaluation"] == {"episodes": 60, "threads": 1, "execution": ExecutionConfig()}


def test_a_share_of_the_data_leaves_labels_shares_of_the_whole(jobs, tmp_path):
    found = jobs(methods="linear", data_share=0.75)
    told = found["cells/linear-0.5-1-seed0"].arguments
    assert told["label_fraction"] == pytest.approx(0.5 / 0.75) and told["cell"]["fraction"] == 0.5
    assert told["settings"]["dataset"] == str(tmp_path / "curve" / "demonstrations-used")
    about = json.loads((tmp_path / "curve/demonstrations-used/ted/about.json").read_text())
    assert about["task"] == "avoiding"


def test_a_planner_of_another_run_is_taken_over_or_refused(jobs, demonstrations, tmp_path):
    run = tmp_path / "run"
    assert koap("train", "--out", run, "--dataset", demonstrations, "--method", "linear", *TINY) == 0
    found = jobs(methods="koap", planner_from=run)
    assert all(job.arguments["planner"] == str(run) and not job.needs for job in found.values())
    with pytest.raises(RunDirectoryError, match="holds a curve with another planner_from"):
        jobs(methods="koap")
    with pytest.raises(RunDirectoryError):
        run_curve(CurveConfig(tmp_path / "other", dataset=str(demonstrations), planner_from=tmp_path / "none"))
    assert not (tmp_path / "other").exists()
