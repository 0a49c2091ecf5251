# This source code is licensed under the MIT license found in the LICENSE file.
"""Names in tables: what is found, and what is said of a name that is not there."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import make_koopman_inverse_dynamics
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.noise_schedule import NoiseSchedule
from torchrl_koap.tasks import get_task

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


@pytest.mark.parametrize("name", ["", "xyzzy", None, 3, ["dense"], {"dense": 1}, b"dense", float("nan")])
def test_without_a_near_name_all_are_listed(name):
    with pytest.raises(ValueError) as error:
        lookup(TABLE, name, "thing")
    assert str(error.value) == f"unknown thing {name!r}; known: dense, diagonal, dpm++2m"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda name: get_task(name), "unknown task"),
        (lambda name: make_koopman_inverse_dynamics(2, 2, preset=name), "unknown preset"),
        (lambda name: NoiseSchedule().solve(None, torch.zeros(1, 1, 1), 1, name), "unknown solver"),
        (lambda name: Normalizer.fit(None, mode=name), "unknown normalisation"),
    ],
)
@pytest.mark.parametrize("name", ["nonsense", 7, ["list"]])
def test_every_table_of_the_library_answers_alike(call, message, name):
    with pytest.raises(ValueError, match=message) as error:
        call(name)
    assert "did you mean" in str(error.value) or "known: " in str(error.value)
