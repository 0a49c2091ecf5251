# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests Wilson interval and mode entropy against their definitions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_koap.evaluation.statistics import (
    bootstrap_interval,
    expected_entropy,
    mode_entropy,
    rate,
    wilson_interval,
)

Z = 1.959963984540054


def test_known_intervals():
    """Values of Newcombe (1998), table I, score method without continuity correction."""
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson_interval(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson_interval(0, 20)[0] == 0.0 and wilson_interval(20, 20)[1] == 1.0
    assert rate([True, True]) == {"rate": 1.0, "low": pytest.approx(0.342, abs=5e-4), "high": 1.0, "episodes": 2}


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_bounds_solve_the_score_equation_and_are_symmetric(case):
    successes, trials = case
    low, high = wilson_interval(successes, trials)
    share = successes / trials
    assert 0 <= low <= share <= high <= 1
    for bound in (low, high):
        if 0 < bound < 1:
            assert (share - bound) ** 2 == pytest.approx(Z**2 * bound * (1 - bound) / trials, rel=1e-6, abs=1e-12)
    assert wilson_interval(trials - successes, trials) == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_known_entropies():
    assert mode_entropy([0, 0, 1, 2], 4) == pytest.approx(0.75)  # (1/2 ln 2 + 2/4 ln 4) / ln 4
    assert mode_entropy(range(24), 24) == pytest.approx(1.0)
    assert mode_entropy([5] * 60, 24) == mode_entropy([], 4) == 0.0 and math.copysign(1, mode_entropy([5], 24)) == 1
    assert mode_entropy([0, 1], 24) == pytest.approx(math.log(2) / math.log(24))


@given(st.lists(st.integers(0, 7), max_size=60), st.randoms())
def test_entropy_is_between_0_and_1_and_blind_to_order_and_names(modes, random):
    entropy = mode_entropy(modes, 8)
    assert 0 <= entropy <= 1 + 1e-12
    shuffled = [7 - mode for mode in modes]
    random.shuffle(shuffled)
    assert mode_entropy(shuffled, 8) == pytest.approx(entropy)
    assert mode_entropy(modes * 3, 8) == pytest.approx(entropy)


@pytest.mark.parametrize(("episodes", "number"), [(3, 2), (5, 3), (4, 4)])
def test_expected_entropy_is_the_mean_over_all_draws(episodes, number):
    draws = np.stack(np.meshgrid(*[range(number)] * episodes), -1).reshape(-1, episodes)
    entropies = [mode_entropy(draw.tolist(), number) for draw in draws]
    assert expected_entropy(episodes, number) == pytest.approx(np.mean(entropies), abs=1e-12)


def test_a_bootstrap_interval_lies_around_the_statistic_and_is_always_the_same():
    numbers = np.random.default_rng(0).normal(size=400).tolist()
    reach = Z * np.std(numbers) / 20
    assert bootstrap_interval(numbers, np.mean) == pytest.approx(
        (np.mean(numbers) - reach, np.mean(numbers) + reach), abs=0.02
    )
    modes = np.random.default_rng(0).integers(24, size=60).tolist()  # resamples lack some of them
    low, high = bootstrap_interval(modes, lambda seen: mode_entropy(seen, 24))
    assert (low + high) / 2 == pytest.approx(mode_entropy(modes, 24), abs=0.01) and 0.03 < high - low < 0.2
    assert bootstrap_interval(modes, lambda seen: mode_entropy(seen, 24)) == (low, high)
