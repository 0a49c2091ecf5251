# This source code is licensed under the MIT license found in the LICENSE file.
"""What is said about a latent model follows from its errors."""

from __future__ import annotations

import math

import pytest

from torchrl_koap.evaluation.latent_verdict import judge_latent_model, unit_circle_sides


def errors(koopman, back, linear, still):
    values = {"koopman": koopman, "reconstruction": back, "linear": linear, "copy_last": still}
    return {"steps": 2} | {name: {"xy": [0.0, value]} for name, value in values.items()}


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        (errors(2.0, 0.01, 0.04, 9.0), ["50 times worse than a linear model"]),
        (errors(2.0, 1.0, 0.04, 9.0), ["50 times worse than a linear model", "alone loses 25 times what"]),
        (errors(3.0, 0.01, 2.0, 1.0), ["3 times worse than standing still"]),
        (errors(1.9, 0.01, 1.0, 9.0), []),
        (errors(0.5, 5.0, 1.0, 9.0), []),  # a poor decoder is no fault where the prediction is good
        (errors(math.nan, 0.1, 0.1, 0.1), ["diverge"]),
        (errors(math.inf, 0.1, 0.1, 0.1), ["diverge"]),
        (errors(0.1, 0.05, 0.0, 9.0), ["infinitely worse", "infinitely"]),
    ],
)
def test_faults(measured, said):
    found = judge_latent_model(measured)
    assert len(found) == len(said)
    for clause, words in zip(found, said, strict=True):
        assert words in clause


def test_sides_of_the_circle():
    assert unit_circle_sides([1.0011, 1.0009, 0.9991, 0.9989]) == ["outside", "on", "on", "inside"]
    assert unit_circle_sides([1.05], tolerance=0.1) == ["on"]
