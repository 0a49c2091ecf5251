# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the run times of the commands of result pages."""


def test_trainings_that_took_as_long_count_one_by_one(benchmark_script, monkeypatch):
    rows = benchmark_script("page_rows")
    trained = [("pusht", "120"), ("adroit_door", "120"), ("adroit_door_1_rad", "120"), ("pusht", "60")]
    made = [{"ground": ground, "seed": "0", "seconds": seconds} for ground, seconds in trained]
    monkeypatch.setattr(rows, "read_rows", {"made": made}.__getitem__)
    assert rows.minutes("made", "seconds") == "5 core minutes of training"  # Adroit's grounds share a training
