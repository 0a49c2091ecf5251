# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the paired comparison: exact cases, coverage of a known difference, unequal pairs, correction."""

import itertools

import numpy as np
import pytest

from torchrl_koap.studies.paired_comparison import compare, compare_cells, holm, sign_flip_p


def outcomes(rates, seed, *, seeds=3, contexts=60):
    generator = np.random.default_rng(seed)
    return {
        number: {(context, context): bool(generator.random() < rates) for context in range(contexts)}
        for number in range(seeds)
    }


def test_p_value_by_hand():
    # |sum| of +-3 +-1 +-1 is 5, 3, 3, 1 and mirrored: 6 of 8 are at least 3
    assert sign_flip_p([3, -1, 1]) == pytest.approx(6 / 8)
    assert sign_flip_p([3, 1, 1]) == pytest.approx(2 / 8)
    assert sign_flip_p([]) == sign_flip_p([1, -1, 0]) == 1.0
    values = [1 / 3, 2 / 3, -1 / 3, 1.0, 0.0]
    sums = [
        sum(s * v for s, v in zip(signs, values[:4], strict=True)) for signs in itertools.product((-1, 1), repeat=4)
    ]
    assert sign_flip_p(values) == np.mean([abs(total) >= abs(sum(values)) - 1e-9 for total in sums])
    assert sign_flip_p([1.0] * 40) == pytest.approx(2 / 10_001)  # of so many, signs are drawn
    assert sign_flip_p([1.0] * 3 + [0.0] * 40) == 2 / 8  # signs of zeros are none


def test_identical_outcomes_differ_by_nothing():
    same = outcomes(0.5, 0)
    result = compare(same, same)
    assert (result.difference, result.p) == (0.0, 1.0)
    # without any spread the rule of three says what contexts not seen could hide
    reach = 3 / result.contexts
    assert (result.low, result.high) == (pytest.approx(-reach), pytest.approx(reach))
    assert (result.contexts, result.seeds, result.n) == (60, 3, 180)


@pytest.mark.parametrize(("contexts", "low"), [(1, 0.0), (2, 0.0), (60, 0.95)])
def test_an_interval_without_spread_stays_within_what_is_possible(contexts, low):
    always, never = ({0: dict.fromkeys([(context, 0) for context in range(contexts)], each)} for each in (1.0, 0.0))
    found, turned = compare(always, never), compare(never, always)
    assert (found.low, found.high) == pytest.approx((low, 1.0)) and found.n == contexts
    assert (turned.low, turned.high) == pytest.approx((-1.0, -low))
    errors = compare(always, never, errors=True)  # errors have no bound, and one trajectory no interval
    assert np.isnan(errors.low) if contexts == 1 else (errors.low, errors.high) == (1.0, 1.0)


def test_swapping_the_methods_swaps_the_signs():
    first, second = outcomes(0.8, 0), outcomes(0.4, 1)
    forth, back = compare(first, second), compare(second, first)
    assert forth.difference == pytest.approx(-back.difference)
    assert (forth.low, forth.high) == pytest.approx((-back.high, -back.low), abs=0.02)
    assert forth.p == back.p < 0.01
    assert forth == compare(first, second)


def test_interval_covers_the_known_difference():
    results = [compare(outcomes(0.7, 2 * n), outcomes(0.5, 2 * n + 1)) for n in range(60)]
    assert all(result.low <= result.difference <= result.high for result in results)
    assert np.mean([result.low <= 0.2 <= result.high for result in results]) >= 0.9
    assert np.mean([result.difference for result in results]) == pytest.approx(0.2, abs=0.02)


def test_seeds_that_disagree_widen_the_interval():
    # seed 0 always wins by everything, seed 1 never: contexts alone would call 0.5 certain
    always = {(context, 0): True for context in range(40)}
    never = {(context, 0): False for context in range(40)}
    result = compare({0: always, 1: never}, {0: never, 1: never})
    assert result.difference == 0.5
    assert (result.low, result.high) == (0.0, 1.0)
    # of four seeds three are drawn: two wins among them are rarer than 1 in 6, three rarer than 1 in 60
    result = compare({0: always, 1: never, 2: never, 3: never}, dict.fromkeys(range(4), never))
    assert (result.difference, result.low, result.high) == (0.25, 0.0, pytest.approx(2 / 3))


def test_rollouts_of_one_context_are_one_unit():
    first = {0: {(context, 10 * context + k): True for context in range(4) for k in range(5)}}
    second = {0: {(context, 10 * context + k): k == 0 for context in range(4) for k in range(5)}}
    result = compare(first, second)
    assert (result.contexts, result.n) == (4, 20)
    assert result.difference == pytest.approx(0.8)
    assert result.p == 2 / 2**4  # four units, not twenty


def test_only_shared_pairs_count():
    first = {0: {(0, 0): True, (1, 1): True}, 1: {(0, 0): True}, 5: {(0, 0): True}}
    second = {0: {(1, 1): False, (2, 2): True}, 1: {(0, 0): True}, 6: {(0, 0): False}}
    result = compare(first, second)
    assert (result.contexts, result.seeds, result.n) == (2, 2, 2)
    assert result.difference == 0.5
    assert compare({0: {(0, 0): True}}, {1: {(0, 0): True}}) is None
    assert compare({0: {(0, 0): True}}, {0: {(1, 1): True}}) is None
    assert compare({}, {}) is None


def test_seeds_that_share_few_contexts_count_only_there():
    """Contexts that a drawn seed lacks are no ties, and draws without any shared context are left out."""
    contexts = {0: range(10), 1: (0,), 2: (0,)}
    first, second = ({s: {(c, 0): good for c in shared} for s, shared in contexts.items()} for good in (1.0, 0.0))
    result = compare(first, second)
    assert (result.difference, result.low, result.high, result.n) == (1.0, pytest.approx(0.7), 1.0, 12)


@pytest.mark.parametrize(("kind", "interval"), [("offline", (None, None)), (None, (0.0, 1.0))])
def test_errors_of_cells_are_not_taken_for_successes(kind, interval):
    """The error of a single trajectory has no interval, the success in a single context has one."""
    place = {"task": "arm", "labels": 1.0, "demonstrations": 1.0, "label_unit": "trajectory", "seed": 0}
    rows = [place | {"method": name, "run": name, "status": "done", "kind": kind} for name in ("koap", "linear")]
    (found,) = compare_cells(rows, {"koap": {(1, 0): 1.0}, "linear": {(1, 0): 0.0}})
    assert (found["difference"], (found["low"], found["high"])) == (1.0, interval)


def test_holm_is_monotone_and_keeps_order():
    assert holm([0.02, 0.5, 0.001, None]) == [0.04, 0.5, 0.003, None]
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
