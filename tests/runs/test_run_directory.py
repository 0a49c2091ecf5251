# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests files of a run: read back as written, rewound exactly, never half-written."""

import errno
import tempfile

import pytest

from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError, writable_folder


@pytest.fixture
def run(tmp_path):
    run = RunDirectory(tmp_path / "deep" / "run")
    for phase, steps in (("planner", (50, 100, 150)), ("controller", (50, 100))):
        for step in steps:
            run.log(phase, step, {f"loss_{'planner' if phase == 'planner' else 'action'}": step / 1000})
    return run


def steps_of(run):
    return [(row["phase"], int(row["step"])) for row in run.read_metrics()]


ALL = [("planner", 50), ("planner", 100), ("planner", 150), ("controller", 50), ("controller", 100)]


def test_rows_are_read_back(run):
    assert steps_of(run) == ALL
    rows = run.read_metrics()
    assert tuple(rows[0]) == ("phase", "step", "loss_planner", "loss_action")
    assert rows[1]["loss_planner"] == "0.1" and rows[1]["loss_action"] == ""
    assert run.last_metrics("planner") == {"loss_planner": 0.15, "updates": 150}
    assert run.last_metrics("controller") == {"loss_action": 0.1, "updates": 100}
    assert run.last_metrics("other") == {}
    run.log("controller", 150, {"kept_update": 100, "loss_action": 2.0})
    assert [type(value) for value in run.last_metrics("controller").values()] == [float, int, int]


@pytest.mark.parametrize(
    ("phase", "step", "kept"),
    [
        ("planner", 0, 0),
        ("planner", 99, 1),
        ("planner", 100, 2),
        ("controller", 0, 3),
        ("controller", 50, 4),
        ("controller", 500, 5),
    ],
)
def test_rewinding_drops_later_rows_and_later_phases(run, phase, step, kept):
    run.rewind_metrics(phase, step)
    assert steps_of(run) == ALL[:kept]
    run.log(phase, step + 1, {})
    assert steps_of(run) == [*ALL[:kept], (phase, step + 1)]


def test_a_row_cut_off_by_a_kill_is_left_out_and_cleaned_up(run):
    path = run.path / "metrics.csv"
    whole = path.read_bytes()
    for cut in range(1, 12):
        path.write_bytes(whole[:-cut])
        assert steps_of(run) == ALL[:-1]
    run.rewind_metrics("controller", 50)
    run.log("controller", 51, {})
    assert steps_of(run) == [*ALL[:-1], ("controller", 51)]


def test_without_metrics_there_is_nothing_to_read_or_rewind(tmp_path):
    run = RunDirectory(tmp_path / "new")
    assert run.read_metrics() == [] and run.last_metrics("planner") == {}
    run.rewind_metrics("planner", 0)
    assert not run.path.exists()


def test_a_folder_that_takes_no_files_is_refused_before_there_are_results(run, monkeypatch):
    def refuse(**options):
        raise PermissionError(errno.EACCES, "Permission denied")

    assert writable_folder(run.path) == run.path
    monkeypatch.setattr(tempfile, "TemporaryDirectory", refuse)
    with pytest.raises(OSError, match=r"run cannot be written to: .*run takes no files \(Permission denied\)"):
        writable_folder(run.path)


def test_the_time_of_a_phase_is_that_of_all_its_calls(tmp_path):
    run = RunDirectory(tmp_path)
    for phase, step, rate in (("planner", 100, 50), ("planner", 300, 20), ("controller", 50, 100)):
        run.log(phase, step, {"iterations_per_second": rate})
    assert run.seconds() == {"planner": 12.0, "controller": 0.5}


def test_a_row_for_which_there_is_no_room_is_told_with_its_file(run, monkeypatch):
    def full(*rest):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("csv.DictWriter.writerow", full)
    with pytest.raises(OSError, match="metrics.csv could not be written: No space left"):
        run.log("planner", 200, {"loss_planner": 0.2})


def test_numbers_that_json_does_not_know_become_null(run):
    run.write_json("summary.json", {"error": float("inf"), "rows": [{"x": float("nan")}, (1.5, -float("inf"))]})
    assert run.read_json("summary.json") == {"error": None, "rows": [{"x": None}, [1.5, None]]}
    assert "Infinity" not in (run.path / "summary.json").read_text()


@pytest.mark.parametrize("text", ["", '{"task": "avo', "[1, 2]", "\x00\x01"])
def test_damaged_json_is_named(run, text):
    (run.path / "config.json").write_text(text)
    with pytest.raises(RunDirectoryError, match="config.json is damaged"):
        run.read_json("config.json")


def test_missing_json_says_what_was_wanted(tmp_path):
    with pytest.raises(RunDirectoryError, match="config.json is missing: wanted the folder of a finished `koap train`"):
        RunDirectory(tmp_path).read_json("config.json")
    with pytest.raises(RunDirectoryError, match="^nope.safetensors is missing: wanted the folder"):
        RunDirectory("nope.safetensors").read_json("config.json")


def test_content_that_json_cannot_hold_leaves_what_was_there(run):
    run.write_json("config.json", {"task": "avoiding"})
    with pytest.raises(TypeError):
        run.write_json("config.json", {"task": object()})
    assert run.read_json("config.json") == {"task": "avoiding"}
    assert sorted(file.name for file in run.path.iterdir()) == ["config.json", "metrics.csv"]


def test_a_new_value_gets_a_column_and_earlier_rows_stay(tmp_path):
    run = RunDirectory(tmp_path)
    run.log("planner", 50, {"loss_planner": 0.5})
    run.log("controller", 50, {"loss_mine": 0.25, "learning_rate": 1.0})
    run.log("controller", 100, {"loss_mine": 0.125, "learning_rate": 0.5})
    assert (tmp_path / "metrics.csv").read_text().splitlines() == [
        "phase,step,loss_planner,loss_mine,learning_rate",
        "planner,50,0.5,,",
        "controller,50,,0.25,1.0",
        "controller,100,,0.125,0.5",
    ]
    assert run.last_metrics("controller") == {"loss_mine": 0.125, "learning_rate": 0.5, "updates": 100}


def test_a_half_written_checkpoint_is_taken_away_by_the_next_one_who_works_there(tmp_path):
    rest = tmp_path / "checkpoints" / ".planner.safetensors.x1.tmp"
    rest.parent.mkdir()
    rest.write_bytes(b"half"), (rest.parent / "planner.safetensors").write_bytes(b"whole")
    with RunDirectory(tmp_path).locked("koap train"):
        assert [path.name for path in rest.parent.iterdir()] == ["planner.safetensors"]
