# This source code is licensed under the MIT license found in the LICENSE file.
"""Bad options and damaged demonstrations: one line before anything runs, and nothing left behind."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from command_calls import contents, fails
from tiny_runs import TINY, write_demonstrations


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--task", "avoidin"), "unknown task 'avoidin'; did you mean 'avoiding'?"),
        (("--method", "kaop"), "unknown method 'kaop'; did you mean 'koap'?"),
        (("--preset", "papper"), "unknown preset 'papper'; did you mean 'paper'?"),
        (("--planner.network", "unnet"), "unknown planner.network 'unnet'; did you mean 'unet'?"),
        (("--strategy", "openloop"), "unknown strategy 'openloop'; did you mean 'open_loop'?"),
        (("--controller.columns", "robbot"), "unknown controller.columns 'robbot'; did you mean 'robot'?"),
        (("--logger", "wandbb"), "unknown logger 'wandbb'; did you mean 'wandb'?"),
        (("--labels.unit", "trajectries"), "unknown unit of labels 'trajectries'; did you mean 'trajectory'?"),
        (("--labels.count", "None", "--labels.fraction", "0.01"), "a label fraction of 0.01 selects none of the 8"),
        (("--labels.count", "None", "--labels.fraction", "1.5"), "labels.fraction must be > 0 and <= 1, got 1.5"),
        (("--labels.fraction", "0.5"), "labels: give one of fraction, count and episodes, got fraction and count"),
        (("--labels", "few"), "--labels must be a number of trajectories such as 5, or a share such as 0.02"),
        (("--labels", "0"), "labels.count must be >= 1, got 0"),
        (("--labels.count", "9"), "9 labelled trajectories asked for, there are 8"),
        (("--dataset", "nowhere"), "dataset 'nowhere' is no folder"),
        (("--steps", "0"), "planner.steps must be >= 1, got 0"),
        (("--planner.batch-size", "0"), "planner.batch_size must be >= 1, got 0"),
        (("--threads", "0"), "run.threads must be >= 1, got 0"),
        (("--device", "gpu"), "device must be 'cpu' or 'cuda', got 'gpu'"),
        (("--planner.source", "nowhere"), "config.json is missing: is nowhere the folder of a finished"),
    ],
)
def test_a_training_that_cannot_be_done_leaves_nothing_behind(options, message, demonstrations, tmp_path, capsys):
    out = tmp_path / "run"
    assert message in fails(capsys, "train", "--out", out, "--dataset", demonstrations, *TINY, *options)
    assert not out.exists()


class Hostile:
    def __reduce__(self):
        return os.system, ("touch owned",)


def damage(folder: Path, kind: str) -> None:
    file = folder / "env_003_00.pkl"
    content = pickle.loads(file.read_bytes())
    if kind == "hostile":
        content["context"] = Hostile()
    elif kind == "nan":
        content["robot"]["c_pos"][4, 1] = np.nan
    elif kind == "infinite":
        content["robot"]["des_c_pos"][2, 0] = np.inf
    elif kind == "lengths":
        content["robot"]["c_pos"] = content["robot"]["c_pos"][:-1]
    elif kind == "key":
        del content["robot"]["des_c_pos"]
    elif kind == "short":
        content["robot"] = {key: value[:9] for key, value in content["robot"].items()}
    data = pickle.dumps(content, protocol=4)
    file.write_bytes({"truncated": data[:200], "empty": b""}.get(kind, data))


DAMAGES = {
    "hostile": "env_003_00.pkl",
    "nan": "'robot/c_pos' is NaN or infinite in 1 values, first in row 4",
    "infinite": "'robot/des_c_pos' is NaN or infinite in 1 values, first in row 2",
    "lengths": "unequal lengths: ",
    "key": "missing key 'robot/des_c_pos'",
    "truncated": "env_003_00.pkl",
    "empty": "env_003_00.pkl",
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_bad_demonstrations_are_named_before_anything_runs(kind, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = write_demonstrations(tmp_path / "data")
    damage(folder, kind)
    for command in (["train", "--out", tmp_path / "run", "--dataset", folder, *TINY], ["validate", folder]):
        line = fails(capsys, *command)
        assert DAMAGES[kind] in line and "env_003_00.pkl" in line
    assert not (tmp_path / "run").exists() and not (tmp_path / "owned").exists()


@pytest.mark.parametrize("options", [(), ("--method", "linear"), ("--preset", "paper")])
def test_trajectories_too_short_for_a_window_are_named_before_the_planner_is_trained(options, tmp_path, capsys):
    folder = write_demonstrations(tmp_path / "data")
    damage(folder, "short")
    line = fails(capsys, "train", "--out", tmp_path / "run", "--dataset", folder, *TINY, *options)
    assert "1 of 8 trajectories are shorter than a window" in line and "3 (8 steps)" in line
    assert not (tmp_path / "run").exists()


def test_a_folder_without_demonstrations_is_named(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    line = fails(capsys, "train", "--out", tmp_path / "run", "--dataset", tmp_path / "data", *TINY)
    assert f"no demonstrations (*.pkl) in {tmp_path / 'data'}" in line


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
