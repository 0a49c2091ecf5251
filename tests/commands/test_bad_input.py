# This source code is licensed under the MIT license found in the LICENSE file.
"""Bad options and demonstrations that are too short: one line before anything runs, and nothing left behind."""

import pytest
from command_calls import contents, fails
from tiny_runs import TINY, write_demonstrations


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--task", "avoidin"), "unknown task 'avoidin'; did you mean 'avoiding'?"),
        (("--labels", "few"), "--labels must be a number of trajectories such as 5, or a share such as 0.02"),
        (("--labels.count", "9"), "9 labelled trajectories asked for, there are 8"),
        (("--dataset", "nowhere"), "dataset 'nowhere' is no folder"),
        (("--planner.source", "nowhere"), "config.json is missing: is nowhere the folder of a finished"),
    ],
)
def test_a_training_that_cannot_be_done_leaves_nothing_behind(options, message, demonstrations, tmp_path, capsys):
    out = tmp_path / "run"
    assert message in fails(capsys, "train", "--out", out, "--dataset", demonstrations, *TINY, *options)
    assert not out.exists()


def test_trajectories_too_short_for_a_window_are_named_before_the_planner_is_trained(tmp_path, capsys):
    data = write_demonstrations(tmp_path / "data", change=lambda i, *paths: [p[: 9 if i == 3 else None] for p in paths])
    line = fails(capsys, "train", "--out", tmp_path / "run", "--dataset", data, *TINY)
    assert "1 of 8 trajectories are shorter than a window" in line and "3 (8 steps)" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "holds a run already; choose another --out, or --resume it"),
        (("--resume", "--seed", "3"), "was started with another run.seed; it cannot be resumed so"),
        (
            ("--resume", "--steps", "30", "--preset", "paper"),
            "was started with another planner.steps, controller.preset; it",
        ),
    ],
)
def test_an_earlier_run_is_not_touched(options, message, copied_run, demonstrations, capsys):
    before = contents(copied_run)
    arguments = ["--dataset", demonstrations, *TINY] if "--resume" not in options else []
    assert message in fails(capsys, "train", "--out", copied_run, *arguments, *options)
    assert contents(copied_run) == before
