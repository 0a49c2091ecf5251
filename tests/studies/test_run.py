# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests ``koap curve``: written files, added cells, resuming, and errors of single cells."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from command_calls import fails
from late_files import wait_until
from tiny_runs import koap, read_csv

from torchrl_koap import ControllerConfig, EvalConfig, ExecutionConfig, PlannerConfig
from torchrl_koap.files import one_at_a_time
from torchrl_koap.runs.config_files import to_json
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies import Machines, Study, run_study
from torchrl_koap.studies import run as run_module

pytestmark = pytest.mark.usefixtures("job_server")
DP, LINEAR = "cells/avoiding/dp-0.25-1-seed0", "cells/avoiding/linear-0.25-1-seed0"
PLANNER = "planners/avoiding/1-seed0"
# two methods, one of them without a planner, of which everything is over in seconds
TINY = {"methods": ("linear", "dp"), "labels": (0.25,), "seeds": 1, "planner.steps": 3, "evaluation.episodes": 1}
TINY |= {"planner.network": "unet", "planner.width": 8}
TINY |= {"controller.steps": 3, "execution.replan_interval": 14}


def run(out, dataset, /, **options):
    asked = TINY | options
    tiny = {name: value for name, value in asked.items() if "." not in name}
    tiny |= {"planner": PlannerConfig(steps=asked["planner.steps"], network="unet", width=8)}
    tiny |= {"controller": ControllerConfig(steps=asked["controller.steps"])}
    tiny |= {"execution": ExecutionConfig(replan_interval=asked["execution.replan_interval"])}
    tiny |= {"evaluation": EvalConfig(episodes=asked["evaluation.episodes"])}
    data = {} if dataset is None else {"datasets": (str(dataset),)}
    result = run_study(Study(out=Path(out), **data, **tiny), Machines(workers=2))
    return {**result.counts, "report": str(result.report)}


def command_of(out, dataset, /, **options):
    asked = {"out": out, "workers": 2} | ({} if dataset is None else {"datasets": (dataset,)}) | TINY | options
    words = ["curve"]
    for name, value in asked.items():
        words += [f"--{name}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def marks(root):
    return {str(file.relative_to(root)): file.stat().st_mtime_ns for file in Path(root).rglob("result.json")}


def rows_of(root):
    return {row["run"]: row for row in read_csv(Path(root) / "cells.csv")}


def episodes_of(root, cell):
    result = json.loads((Path(root) / cell / "eval.json").read_text())
    return result["episode"], result["rates"]["success"]["rate"], result["mean_steps"]


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


def test_what_a_curve_writes(whole_curve):
    assert {path.name for path in whole_curve.iterdir()} == {
        *("begun_with", "cells", "cells.csv", "comparisons.csv", "index.html", "lock", "planners", "plots"),
        *("study.json", "table.md"),
    }
    rows = rows_of(whole_curve)
    assert set(rows) == {DP, LINEAR} and {row["status"] for row in rows.values()} == {"done"}
    for name, row in rows.items():
        episodes, rate, _ = episodes_of(whole_curve, name)
        assert int(row["episodes"]) == len(episodes) == 1 and float(row["success_rate"]) == rate
        assert int(row["successes"]) == sum(episode["outcome"] == "success" for episode in episodes)
        assert (whole_curve / name / "log.txt").read_text()
    planner = "planner.safetensors"
    assert (whole_curve / LINEAR / planner).read_bytes() == (whole_curve / PLANNER / planner).read_bytes()
    assert not (whole_curve / DP / planner).exists()
    assert "| 25 % | linear |" in (whole_curve / "table.md").read_text()
    assert "Label efficiency on avoiding" in (whole_curve / "index.html").read_text()
    assert (whole_curve / "plots" / "avoiding_success.png").stat().st_size > 1000
    assert not [path for path in whole_curve.rglob("*") if ".tmp" in path.name]


def test_methods_labels_and_seeds_may_be_added(curve, demonstrations, monkeypatch):
    read, original, before = [], run_module.cell_row, marks(curve)
    monkeypatch.setattr(
        run_module, "cell_row", lambda root, cell, **more: read.append(cell.folder) or original(root, cell, **more)
    )
    assert run(curve, demonstrations, methods=("dd",), labels=(0.5,), seeds=2)["done"] == 4
    after = marks(curve)
    assert {name: after[name] for name in before} == before
    added = {f"cells/avoiding/dd-0.5-1-seed{seed}" for seed in (0, 1)}
    assert set(rows_of(curve)) == {DP, LINEAR} | added
    assert list(dict.fromkeys(row["method"] for row in rows_of(curve).values())) == ["linear", "dp", "dd"]
    assert sorted(read) == sorted([DP, LINEAR, *added, *added])  # each once at first, and again when it has ended
    kept = json.loads((curve / "study.json").read_text())
    assert (kept["methods"], kept["labels"], kept["seeds"]) == (["linear", "dp", "dd"], [0.25, 0.5], 2)


def test_a_finished_cell_without_a_log_stays_in_the_table(curve, demonstrations):
    for cell in (DP, LINEAR):  # as if they were run by hand
        (curve / cell / "log.txt").unlink()
    before = rows_of(curve)
    assert run(curve, demonstrations, methods=("linear",))["done"] == 2
    assert rows_of(curve) == before


def test_part_of_the_demonstrations_has_a_planner_of_its_own(curve, demonstrations, capsys):
    assert run(curve, demonstrations, methods=("linear",), demonstrations=(0.5,))["done"] == 3
    shown = capsys.readouterr().err
    assert "trainings: 100%" in shown and "2/2" in shown and "cells:" not in shown  # the planner is no cell
    cell = curve / "cells/avoiding/linear-0.25-0.5-seed0"
    planners = [folder / "planner.safetensors" for folder in (cell, curve / "planners/avoiding/0.5-seed0")]
    one, other = (file.read_bytes() for file in planners)
    assert one == other != (curve / PLANNER / "planner.safetensors").read_bytes()
    assert json.loads((cell / "summary.json").read_text())["trajectories_used"] == 3  # of four, one is held out


def test_scripted_demonstrations_are_recorded_once_and_a_call_that_finds_too_few_may_be_repeated(
    tmp_path, capsys, monkeypatch
):
    out, options = tmp_path / "curve", {"record": 4, "methods": ("linear",), "label_unit": "window"}
    assert koap(*command_of(out, None, **(options | {"labels": (0.0001,)}))) == 1
    assert "selects none of the" in capsys.readouterr().err.splitlines()[-1]
    assert {path.name for path in out.iterdir()} == {"demonstrations", "lock"}
    monkeypatch.setattr(
        "torchrl_koap.envs.experts.demonstrations.record_to_folder", lambda *rest, **more: pytest.fail("again")
    )
    assert run(out, None, **options)["done"] == 1
    (row,) = rows_of(out).values()
    assert row["label_unit"] == "window" and row["trajectories_touched"] == "4"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"planner.steps": 4}, "holds a study with another planner.steps (3); choose another --out"),
        ({"evaluation.episodes": 2, "label_unit": "window"}, "label_unit (trajectory), evaluation.episodes (1)"),
        ({"datasets": ()}, "with another datasets (avoiding="),
    ],
)
def test_other_settings_are_named(options, message, curve, demonstrations, capsys):
    before = marks(curve), (curve / "study.json").read_bytes()
    assert message in fails(capsys, *command_of(curve, demonstrations, **options))
    assert (marks(curve), (curve / "study.json").read_bytes()) == before


def test_demonstrations_that_changed_are_refused(curve, demonstrations, monkeypatch):
    monkeypatch.setattr(run_module, "fingerprint", lambda data: {"steps": 7, "sha256": ""})
    with pytest.raises(RunDirectoryError, match="started with other demonstrations .* 7 now"):
        run(curve, demonstrations, methods=("linear", "pca"))


def test_the_same_demonstrations_may_lie_elsewhere(curve, demonstrations, tmp_path):
    scratch = shutil.copytree(demonstrations, tmp_path / "scratch")
    assert run(curve, scratch, methods=("linear", "pca"))["done"] == 3
    assert json.loads((curve / "study.json").read_text())["datasets"] == [f"avoiding={scratch}"]


def test_a_folder_of_something_else_is_left_alone(tmp_path, demonstrations, capsys):
    (tmp_path / "thesis.tex").write_text("precious")
    assert "is not empty and not a folder of `koap curve`" in fails(capsys, *command_of(tmp_path, demonstrations))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert "thesis.tex is no folder" in fails(capsys, *command_of(tmp_path / "thesis.tex", demonstrations))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"methods": ("kaop",)}, "unknown method 'kaop'; did you mean 'koap'?"),
        ({"labels": (0,)}, "labels must be shares in (0, 1], got 0"),
        ({"labels": (0.1, 1.5)}, "labels must be shares in (0, 1], got 1.5"),
        ({"labels": ("nan",)}, "--labels must be a finite number, got nan"),
        ({"labels": (0.25, 0.01)}, "a label fraction of 0.01 selects none of the 8 trajectories"),
        ({"demonstrations": (0.05,)}, "a share of 0.05 of the trajectories keeps 0 of 8, but"),
        ({"labels": (0.5,), "demonstrations": (0.25,)}, "keeps 2 of 8, but 4 have labels"),
        ({"label_unit": "trajectories"}, "unknown unit of labels 'trajectories'; did you mean 'trajectory'?"),
        ({"tasks": ("avoidin",)}, "unknown task 'avoidin'; did you mean 'avoiding'?"),
        ({"datasets": ("nowhere",)}, "nowhere"),
        ({"seeds": 0}, "seeds must be >= 1, got 0"),
        ({"datasets": (), "record": 40, "labels": (0.01,)}, "selects none of the 40 trajectories"),
        ({"levels": (6,), "labels": ()}, "has no label level 6: its levels 1 to 5 are 2, 5, 10, 25, 50 %"),
        ({"preset": "table3"}, "unknown preset 'table3'; did you mean 'table"),
        ({"methods": ("koap", "dp"), "execution.blend": 0.5}, "blend 0.5 was asked of method 'dp', which samples"),
        ({"execution.replan_interval": 15}, "replan_interval must be in 1..14"),
        ({"tasks": ("avoiding", "sorting")}, "datasets must be TASK=FOLDER if there are several tasks"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line_before_any_work(
    options, message, tmp_path, demonstrations, capsys, monkeypatch
):
    monkeypatch.setattr(
        "torchrl_koap.envs.experts.demonstrations.record_to_folder", lambda *rest, **more: pytest.fail("work")
    )
    assert message in fails(capsys, *command_of(tmp_path / "curve", demonstrations, **options))
    assert list(tmp_path.iterdir()) == []


def test_the_paper_has_two_tables(tmp_path, capsys, monkeypatch):
    assert "table must be 1 or 2, got 3" in fails(capsys, "bench", "--table", 3, "--out", tmp_path / "bench")
    assert list(tmp_path.iterdir()) == []
    asked = []

    def note(study, machines):
        asked.append(study.preset)
        return run_module.StudyResult([], {"done": 0, "failed": 0, "missing": 0}, study.out)

    monkeypatch.setattr("torchrl_koap.commands.run_commands.run_study", note)
    for table in (1, 2):
        koap("bench", "--table", table, "--out", tmp_path / "bench")
    assert asked == ["table1", "table2"]


def test_windows_of_every_seed_must_lie_in_the_trajectories_used(tmp_path, demonstrations, capsys):
    """Of which a seed touches more than another: found before any work, and not by the cell."""
    options = {"label_unit": "window", "labels": (0.02,), "demonstrations": (0.25,), "seeds": 10}
    assert "keeps 2 of 8, but" in fails(capsys, *command_of(tmp_path / "curve", demonstrations, **options))
    assert list(tmp_path.iterdir()) == []


def test_two_curves_do_not_work_in_one_folder(curve, demonstrations, capsys):
    with one_at_a_time(curve / "lock", busy=""):
        assert f"another command is working in {curve}: call `koap curve` again" in fails(
            capsys, *command_of(curve, demonstrations)
        )


def test_a_cell_that_fails_is_named_and_tried_again(curve, demonstrations, capsys):
    before = marks(curve)
    blocked = curve / "cells/avoiding/dd-0.25-1-seed0"
    blocked.write_text("in the way")
    counts = run(curve, demonstrations, methods=("linear", "dp", "dd", "pretrain"))
    assert (counts["done"], counts["failed"], counts["missing"]) == (3, 1, 0)
    row = rows_of(curve)[str(blocked.relative_to(curve))]
    assert row["status"] == "failed" and "FileExistsError" in row["reason"]
    assert row["reason"] in (curve / "table.md").read_text()
    assert "FileExistsError" in (curve / "index.html").read_text()
    capsys.readouterr()
    assert koap(*command_of(curve, demonstrations, methods=("dd",)), "--quiet") == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("koap: avoiding, dd, 25 % labels, seed 0: failed: FileExistsError")
    assert run(curve, demonstrations, methods=("linear",))["failed"] == 1  # not asked again, but still reported
    assert rows_of(curve)[str(blocked.relative_to(curve))] == row
    blocked.unlink()
    assert run(curve, demonstrations, methods=("linear", "dp", "dd", "pretrain"))["done"] == 4
    after = marks(curve)
    assert {name: after[name] for name in before} == before and len(after) == 5


def test_a_damaged_study_json_is_named(curve, demonstrations, capsys):
    os.truncate(curve / "study.json", 20)
    assert f"{curve / 'study.json'} is damaged" in fails(capsys, *command_of(curve, demonstrations))


def test_a_damaged_table_of_cells_is_written_again(tmp_path):
    failed = b"run,status,reason\ncells/a,failed,no memory\n"
    for content, reasons in ((failed, {"cells/a": "no memory"}), (b"\xff\n", {}), (failed + 200_000 * b"x", {})):
        (tmp_path / "cells.csv").write_bytes(content)
        assert run_module._failed_before(tmp_path) == reasons


def living(session):
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
        wait_until(lambda: (out / LINEAR / "config.json").exists() or process.poll() is not None)
    finally:
        process.kill()
        process.wait()
    wait_until(lambda: not living(process.pid))
    before = marks(out)
    assert f"{PLANNER}/result.json" in before and not (out / "index.html").exists()
    assert not (out / DP / "result.json").exists()
    assert run(out, demonstrations)["done"] == 2
    after = marks(out)
    assert {name: after[name] for name in before} == before
    for cell in (DP, LINEAR):
        assert episodes_of(out, cell) == episodes_of(whole_curve, cell)
        name = "controller.safetensors"
        assert (out / cell / name).read_bytes() == (whole_curve / cell / name).read_bytes()


@pytest.fixture
def begun(tmp_path):
    """A study that an earlier call has begun."""
    study = run_module.complete(Study(out=tmp_path, seeds=3, planners=("pretrained:avoiding",)))
    RunDirectory(tmp_path).write_json("study.json", to_json(replace(study, out=Path())))
    return study


def test_fewer_seeds_remove_no_cells(begun):
    assert run_module._together(replace(begun, seeds=1)) == begun


def test_another_shared_planner_is_another_study(begun):
    run_module._check_folder(begun)
    for planners in ((), ("avoiding=/elsewhere",)):
        with pytest.raises(RunDirectoryError, match="with another planners .avoiding=.*; choose another --out"):
            run_module._check_folder(replace(begun, planners=planners))


def test_a_planner_whose_weights_are_gone_is_trained_again(tmp_path):
    RunDirectory(tmp_path).write_json("result.json", {"row": {}, "outcomes": []})
    assert not run_module._is_trained(tmp_path)
    (tmp_path / "planner.safetensors").touch()
    assert run_module._is_trained(tmp_path)
