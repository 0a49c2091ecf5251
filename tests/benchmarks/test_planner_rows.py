# This source code is licensed under the MIT license found in the LICENSE file.
"""Planners in tables: known ones by their short name with what they have besides, others in full."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def rows(benchmark_script):
    return benchmark_script("planner_rows")


def test_a_known_planner_has_its_short_name(rows):
    for name, options in rows.PLANNERS.items():
        assert rows.planner_words(options) == name


def test_what_a_known_planner_has_besides_is_told(rows):
    options = rows.PLANNERS["wide MLP"] + " frame=target plan_steps=1,2,4"
    assert rows.planner_words(options) == "wide MLP, `frame=target`, `plan_steps=1,2,4`"


def test_another_planner_is_told_in_full(rows):
    narrow = rows.PLANNERS["wide MLP"].replace("512", "256")
    assert rows.planner_words(narrow) == f"`{narrow}`"
    assert rows.planner_words("unet channels=(64, 128) precision=bfloat16").startswith("`unet channels=(64, 128)")


def test_amounts_differ_in_the_demonstrations_alone(rows):
    found = rows.amounts()
    assert found and {row["updates"] for row in found} == {rows.SHORT}
    assert len({(row["labels"], row["denoiser"], row["batch"]) for row in found}) == 1
    numbers = [(rows.disturbed(row), int(row["demonstrations"])) for row in found]
    assert numbers == sorted(numbers)


def test_the_picture_is_drawn(rows, tmp_path):
    assert rows.draw_amounts(tmp_path / "amounts.png").stat().st_size > 5000
