# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the run times of the commands of result pages, and their numbers of rollouts."""

import re
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "benchmarks" / "results"


def test_trainings_that_took_as_long_count_one_by_one(benchmark_script, monkeypatch):
    rows = benchmark_script("page_rows")
    trained = [("pusht", "120"), ("adroit_door", "120"), ("adroit_door_1_rad", "120"), ("pusht", "60")]
    made = [{"ground": ground, "seed": "0", "seconds": seconds} for ground, seconds in trained]
    monkeypatch.setattr(rows, "read_rows", {"made": made}.__getitem__)
    assert rows.minutes("made", "seconds") == "5 core minutes of training"  # Adroit's grounds share a training


def test_entries_of_other_numbers_of_seeds_are_named(benchmark_script, monkeypatch):
    rows = benchmark_script("page_rows")
    seeds = {"koap": 3, "pca": 5, "dp": 1}  # the last is in no column
    made = [{"regime": "plain", "method": method, "n": "60"} for method, count in seeds.items() for _ in range(count)]
    monkeypatch.setattr(rows, "read_rows", lambda *_, **__: made)
    assert rows.followed_rollouts(2, ["plain"]) == "180 (3 seeds) or 300 (5 seeds)"


def test_commands_of_a_page_make_every_row_of_its_table():
    page = (SOURCE / "unlabelled_data.md.jinja").read_text()
    shown = re.findall(r"\w+", re.search(r"set regimes = \[(.*?)\]", page)[1])
    assert set(shown) == set(re.search(r"--observed (.*) --rollouts", page)[1].split())
    assert "--task scooping_moving_bowl" in (SOURCE / "scooping.md.jinja").read_text()
