# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the lookup of names in tables, and the errors of unknown names."""

import pickle

import pytest

from torchrl_koap.lookup import lookup, resolve

TABLE = {"dense": 1, "diagonal": 2, "dpm++2m": None}


def test_what_is_found():
    assert [lookup(TABLE, name, "thing") for name in TABLE] == [1, 2, None]
    assert lookup(("a", "b"), "b", "letter") == "b"
    assert lookup({"a", "b"}, "a", "letter") == "a"


@pytest.mark.parametrize(
    ("name", "near"),
    [("diagnal", "diagonal"), ("Dense", "dense"), ("DENS", "dense"), ("dpm++", "dpm++2m"), ("dpmpp2m", "dpm++2m")],
)
def test_the_nearest_name_is_suggested(name, near):
    with pytest.raises(ValueError) as error:
        lookup(TABLE, name, "thing")
    assert str(error.value) == f"unknown thing {name!r}; did you mean {near!r}?"


@pytest.mark.parametrize("name", ["", "xyzzy", None, ["dense"], float("nan")])
def test_without_a_near_name_all_are_listed(name):
    with pytest.raises(ValueError) as error:
        lookup(TABLE, name, "thing")
    assert str(error.value) == f"unknown thing {name!r}; known: dense, diagonal, dpm++2m"


def test_the_columns_of_an_entry_are_suggested():
    with pytest.raises(ValueError, match=r"unknown column 'eef'; did you mean eef_0 eef_1\?"):
        lookup(["eef_pos", "eef_0", "eef_1"], "eef", "column")


def test_a_file_may_define_dataclasses_and_its_objects_can_be_pickled(tmp_path):
    code = "from __future__ import annotations\nfrom dataclasses import dataclass\n\n"
    for folder, number in (("a", 1), ("b", 2)):  # files of the same name
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.py").write_text(f"{code}@dataclass\nclass Options:\n    number: int = {number}\n")
    made = [resolve(f"{tmp_path}/{folder}/own.py:Options", "options")() for folder in "ab"]
    assert [each.number for each in made] == [1, 2] and pickle.loads(pickle.dumps(made)) == made
