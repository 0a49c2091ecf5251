# This source code is licensed under the MIT license found in the LICENSE file.
"""The table of planners that were tried: rows of before a column was there are filled, nothing is lost."""

from __future__ import annotations

import csv
import json

import pytest


@pytest.fixture(scope="module")
def script(benchmark_script):
    return benchmark_script("planner_ablations")


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows_of_before_the_column_had_a_learned_controller(script, tmp_path):
    table = tmp_path / "new" / "rows.csv"
    script.append({"task": "avoiding", "n": 60}, table)
    script.append({"task": "aligning", "n": 180, "controller": "oracle"}, table)
    assert rows_of(table) == [
        {"task": "avoiding", "n": "60", "controller": "learned"},
        {"task": "aligning", "n": "180", "controller": "oracle"},
    ]


def test_no_column_is_lost(script, tmp_path):
    table = tmp_path / "rows.csv"
    script.append({"task": "avoiding", "by_hand": "a note"}, table)
    before = table.read_bytes()
    with pytest.raises(ValueError, match="has columns that no row gets any more: by_hand"):
        script.append({"task": "aligning"}, table)
    assert table.read_bytes() == before


def test_disturbed_demonstrations_are_told_by_their_notes(script, tmp_path):
    place = tmp_path / "demos" / "ted"
    place.mkdir(parents=True)
    about = place / "about.json"
    for notes, share in (({"disturbance": {"share": 0.5}}, 0.5), ({"seed": 0}, 0.0), (None, 0.0)):
        about.write_text(json.dumps({"notes": notes}))
        assert script.disturbed_share(str(tmp_path / "demos")) == script.disturbed_share(str(place)) == share
    assert script.disturbed_share("scripted") == 0.0


def test_a_planner_that_was_handed_on_is_described_by_the_run_that_trained_it(script, tmp_path):
    given = {"task": "avoiding", "method": "koap", "seed": 0, "label_fraction": 1, "denoiser": "mlp", "command": "koap"}
    given |= {"dataset": "scripted", "batch_size": 64}
    summary = {"labels": {}, "trajectories_used": 5, "train_seconds": {"planner": 1.0, "controller": 1.0}}
    source = None
    for name, steps in (("trained", 700), ("taken", 5000), ("again", 5000)):
        (tmp_path / name).mkdir()
        config = given | {"steps": steps, "planner_from": source}
        for file, content in (("config.json", config), ("summary.json", summary)):
            (tmp_path / name / file).write_text(json.dumps(content))
        source = str(tmp_path / name)
    episode = {"outcome": "success", "mode": 1, "steps": 50}
    row = script.row_of(tmp_path / "again", [{"episode": [episode]}], {}, "")
    assert (row["updates"], row["successes"], row["labels"]) == (700, 1, "all")
