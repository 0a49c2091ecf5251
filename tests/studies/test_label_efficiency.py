# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap curve``: what it writes, that it grows and goes on without redoing, and that nothing takes it down."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_runs import koap

from torchrl_koap.studies.label_efficiency import CurveConfig, run_curve
from torchrl_koap.studies.table import read_cells

DP, LINEAR = "cells/dp-0.25-1-seed0", "cells/linear-0.25-1-seed0"


def options_of(out, dataset, /, **options):
    """Two methods, one of them without a planner, of which everything is over in seconds."""
    tiny = {"methods": "linear,dp", "fractions": "0.25", "seeds": 1, "steps": 3, "episodes": 1, "workers": 2}
    return {"out": Path(out), "dataset": str(dataset), **tiny, **options}


def run(out, dataset, /, **options):
    return run_curve(CurveConfig(**options_of(out, dataset, **options)))


def command_of(out, dataset, /, **options):
    return ["curve", *(f"--{name}={value}" for name, value in options_of(out, dataset, **options).items())]


def marks(root):
    return {str(file.relative_to(root)): file.stat().st_mtime_ns for file in Path(root).rglob("cell.json")}


def rows_of(root):
    return {row["run"]: row for row in read_cells(Path(root) / "cells.csv")}


def episodes_of(root, cell):
    result = json.loads((Path(root) / cell / "eval.json").read_text())
    return result["episode"], result["success_rate"], result["mean_steps"]


@pytest.fixture(scope="module")
def whole_curve(tmp_path_factory, demonstrations):
    """Not to be written to."""
    folder = tmp_path_factory.mktemp("curves") / "whole"
    counts = run(folder, demonstrations)
    assert counts == {"done": 2, "failed": 0, "missing": 0, "report": str(folder / "index.html")}
    return folder


@pytest.fixture
def curve(whole_curve, tmp_path):
    folder = tmp_path / "curve"
    shutil.copytree(whole_curve, folder)
    return folder


def fails(capsys, *arguments):
    """The one line of a command that cannot be done."""
    capsys.readouterr()
    assert koap(*arguments) == 1
    out, err = capsys.readouterr()
    assert out == "" and len(err.strip().splitlines()) == 1 and err.startswith("koap: "), err
    return err


def test_what_a_curve_writes(whole_curve):
    assert {path.name for path in whole_curve.iterdir()} == {
        *("cells", "cells.csv", "comparisons.csv", "curve.json", "index.html", "lock", "planner-1", "plots", "table.md")
    }
    rows = rows_of(whole_curve)
    assert set(rows) == {DP, LINEAR} and {row["status"] for row in rows.values()} == {"done"}
    for name, row in rows.items():
        episodes, rate, _ = episodes_of(whole_curve, name)
        assert row["episodes"] == len(episodes) == 1 and row["success_rate"] == rate
        assert row["successes"] == sum(episode["outcome"] == "success" for episode in episodes)
        assert (whole_curve / name / "log.txt").read_text()
    planner = "planner.safetensors"
    assert (whole_curve / LINEAR / planner).read_bytes() == (whole_curve / "planner-1" / planner).read_bytes()
    assert not (whole_curve / DP / planner).exists()
    assert "| 25 % | linear |" in (whole_curve / "table.md").read_text()
    assert "Label efficiency on avoiding" in (whole_curve / "index.html").read_text()
    assert (whole_curve / "plots" / "avoiding_success.png").stat().st_size > 1000
    assert not [path for path in whole_curve.rglob("*") if ".tmp" in path.name]


def test_a_second_call_redoes_nothing(curve, demonstrations):
    before = marks(curve)
    (curve / "index.html").unlink()
    assert run(curve, demonstrations)["done"] == 2
    assert len(before) == 3 and marks(curve) == before
    assert (curve / "index.html").exists()


def test_methods_fractions_and_seeds_may_be_added(curve, demonstrations):
    before = marks(curve)
    assert run(curve, demonstrations, methods="dd", fractions="0.5", seeds=2)["done"] == 4
    after = marks(curve)
    assert {name: after[name] for name in before} == before
    assert set(rows_of(curve)) == {DP, LINEAR, "cells/dd-0.5-1-seed0", "cells/dd-0.5-1-seed1"}
    kept = json.loads((curve / "curve.json").read_text())
    assert (kept["methods"], kept["fractions"], kept["seeds"]) == ("linear,dp,dd", "0.25,0.5", 2)


def test_part_of_the_trajectories_has_a_planner_of_its_own(curve, demonstrations):
    assert run(curve, demonstrations, methods="linear", observations="0.5")["done"] == 3
    cell = curve / "cells/linear-0.25-0.5-seed0"
    planners = [(folder / "planner.safetensors").read_bytes() for folder in (cell, curve / "planner-0.5")]
    assert planners[0] == planners[1] != (curve / "planner-1" / "planner.safetensors").read_bytes()
    assert json.loads((cell / "summary.json").read_text())["trajectories_used"] == 4


def test_scripted_demonstrations_are_recorded_once_and_a_call_that_finds_too_few_may_be_repeated(
    tmp_path, capsys, monkeypatch
):
    out, options = tmp_path / "curve", {"demonstrations": 4, "methods": "linear", "units": "window"}
    assert koap(*command_of(out, "scripted", fractions="0.0001", **options)) == 1
    assert "selects none of the" in capsys.readouterr().err.splitlines()[-1]
    assert {path.name for path in out.iterdir()} == {"demonstrations", "lock"}
    monkeypatch.setattr(
        "torchrl_koap.envs.experts.demonstrations.record_demonstrations", lambda *rest, **more: pytest.fail("again")
    )
    assert run(out, "scripted", fractions="0.25", **options)["done"] == 1
    (row,) = rows_of(out).values()
    assert row["label_unit"] == "window" and row["trajectories_touched"] == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 4}, "holds a curve with another steps (3); choose another --out"),
        ({"episodes": 2, "units": "window"}, "with another units (trajectory), episodes (1)"),
        ({"dataset": "."}, "with another dataset ("),
    ],
)
def test_other_settings_are_named(options, message, curve, demonstrations, capsys):
    before = marks(curve), (curve / "curve.json").read_bytes()
    assert message in fails(capsys, *command_of(curve, demonstrations, **options))
    assert (marks(curve), (curve / "curve.json").read_bytes()) == before


def test_a_folder_of_something_else_is_left_alone(tmp_path, demonstrations, capsys):
    (tmp_path / "thesis.tex").write_text("precious")
    assert "is not empty and no folder of `koap curve`" in fails(capsys, *command_of(tmp_path, demonstrations))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert "thesis.tex is no folder" in fails(capsys, *command_of(tmp_path / "thesis.tex", demonstrations))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"methods": "kaop"}, "unknown method 'kaop'; did you mean 'koap'?"),
        ({"methods": " , "}, "methods must name at least one"),
        ({"fractions": "0"}, "fractions must be in (0, 1], got 0"),
        ({"fractions": "0.1,1.5"}, "fractions must be in (0, 1], got 1.5"),
        ({"fractions": "nan"}, "fractions must be in (0, 1], got nan"),
        ({"fractions": "abc"}, "fractions must be numbers with commas between, got 'abc'"),
        ({"fractions": "0.25,0.01"}, "a label fraction of 0.01 selects none of the 8 trajectories"),
        ({"observations": "0.05"}, "an observation fraction of 0.05 keeps 0 of 8 trajectories"),
        ({"fractions": "0.5", "observations": "0.25"}, "keeps 2 of 8 trajectories, but 4 have labels"),
        ({"units": "trajectories"}, "unknown unit 'trajectories'; did you mean 'trajectory'?"),
        ({"task": "avoidin"}, "unknown task 'avoidin'; did you mean 'avoiding'?"),
        ({"dataset": "nowhere"}, "nowhere' is neither 'scripted' nor a folder"),
        ({"seeds": 0}, "seeds must be >= 1, got 0"),
        ({"episodes": 0}, "episodes must be >= 1, got 0"),
        ({"steps": 0}, "steps must be >= 1, got 0"),
        ({"workers": 0}, "workers must be >= 1, got 0"),
        ({"launcher": "lokal"}, "unknown launcher 'lokal'; did you mean 'local'?"),
        ({"address": "10.0.0.1:1"}, "launcher 'local' works on this machine alone"),
        ({"dataset": "scripted", "demonstrations": 40, "fractions": "0.01"}, "selects none of the 40 trajectories"),
        ({"dataset": "scripted", "units": "windows"}, "unknown unit 'windows'; did you mean 'window'?"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line_before_any_work(
    options, message, tmp_path, demonstrations, capsys, monkeypatch
):
    monkeypatch.setattr(
        "torchrl_koap.envs.experts.demonstrations.record_demonstrations", lambda *rest, **more: pytest.fail("work")
    )
    assert message in fails(capsys, *command_of(tmp_path / "curve", demonstrations, **options))
    assert list(tmp_path.iterdir()) == []


def test_windows_of_every_seed_must_lie_in_the_trajectories_used(tmp_path, demonstrations, capsys):
    """Of which a seed touches more than another: found before any work, and not by the cell."""
    options = {"units": "window", "fractions": "0.02", "observations": "0.25", "seeds": 10}
    assert "keeps 2 of 8 trajectories, but" in fails(capsys, *command_of(tmp_path / "curve", demonstrations, **options))
    assert list(tmp_path.iterdir()) == []


def test_two_curves_do_not_work_in_one_folder(curve, demonstrations, capsys):
    holds = (
        "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_EX); print('held', flush=True); input()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", holds, str(curve / "lock")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "held\n"
        assert f"another `koap curve` is working in {curve}" in fails(capsys, *command_of(curve, demonstrations))
    finally:
        other.communicate("\n")
    assert run(curve, demonstrations)["done"] == 2


def test_a_cell_that_fails_is_named_and_tried_again(curve, demonstrations):
    before = marks(curve)
    blocked = curve / "cells/dd-0.25-1-seed0"
    blocked.write_text("in the way")
    counts = run(curve, demonstrations, methods="linear,dp,dd,pretrain")
    assert (counts["done"], counts["failed"], counts["missing"]) == (3, 1, 0)
    row = rows_of(curve)[str(blocked.relative_to(curve))]
    assert row["status"] == "failed" and "FileExistsError" in row["reason"]
    assert row["reason"] in (curve / "table.md").read_text()
    assert "FileExistsError" in (curve / "index.html").read_text()
    blocked.unlink()
    assert run(curve, demonstrations, methods="linear,dp,dd,pretrain")["done"] == 4
    after = marks(curve)
    assert {name: after[name] for name in before} == before and len(after) == 5


def test_a_planner_that_fails_fails_the_cells_that_need_it_and_no_other(curve, demonstrations):
    shutil.rmtree(curve / "planner-1")
    shutil.rmtree(curve / LINEAR)
    (curve / "planner-1").write_text("in the way")
    counts = run(curve, demonstrations)
    assert (counts["done"], counts["failed"]) == (1, 1)
    assert rows_of(curve)[LINEAR]["reason"].startswith("planner-1 failed: FileExistsError")
    assert rows_of(curve)[DP]["status"] == "done"
    assert run(curve, demonstrations, methods="dp")["missing"] == 0  # what never began is not asked for now
    (curve / "planner-1").unlink()
    assert run(curve, demonstrations)["done"] == 2


def test_damaged_cells_are_made_again_and_those_not_asked_for_are_named(curve, demonstrations):
    before = {name: episodes_of(curve, name) for name in (DP, LINEAR)}
    os.truncate(curve / DP / "eval.json", 20)
    os.truncate(curve / LINEAR / "cell.json", 20)
    counts = run(curve, demonstrations, methods="linear")
    assert (counts["done"], counts["failed"]) == (1, 1)
    assert "eval.json is damaged" in rows_of(curve)[DP]["reason"]
    assert run(curve, demonstrations)["done"] == 2
    assert {name: episodes_of(curve, name) for name in before} == before


def test_a_damaged_curve_json_is_named(curve, demonstrations, capsys):
    os.truncate(curve / "curve.json", 20)
    assert f"{curve / 'curve.json'} is damaged" in fails(capsys, *command_of(curve, demonstrations))


def wait_for(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def living(session):
    """Processes of a session that still do something."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of = file.read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it ended meanwhile
            continue
        if int(of) == session and state != "Z":
            found.append(file.parent.name)
    return found


def test_a_curve_that_was_killed_goes_on_and_ends_like_one_that_was_not(whole_curve, demonstrations, tmp_path):
    """Killed alone, by -9, while a cell was made: its processes die with it, and what was finished stays as it is."""
    out = tmp_path / "curve"
    command = [sys.executable, "-m", "torchrl_koap.commands.cli", *command_of(out, demonstrations, workers=1)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        wait_for(lambda: (out / DP / "config.json").exists() or process.poll() is not None)
    finally:
        process.kill()
        process.wait()
    wait_for(lambda: not living(process.pid))
    before = marks(out)
    assert "planner-1/cell.json" in before and not (out / "index.html").exists()
    assert not (out / LINEAR / "cell.json").exists()
    assert run(out, demonstrations)["done"] == 2
    after = marks(out)
    assert {name: after[name] for name in before} == before
    for cell in (DP, LINEAR):
        assert episodes_of(out, cell) == episodes_of(whole_curve, cell)
        name = "controller.safetensors"
        assert (out / cell / name).read_bytes() == (whole_curve / cell / name).read_bytes()
