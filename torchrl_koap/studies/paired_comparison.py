# This source code is licensed under the MIT license found in the LICENSE file.
"""Is one method better than another? Paired comparison of their successes on the same evaluation contexts.

Two methods that were evaluated on the same contexts with the same seeds are compared context by context: hard contexts
are hard for both, and what is common to both falls out of the difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import permutation_test

from torchrl_koap.evaluation.offline import KIND
from torchrl_koap.studies.table import group_cells

Outcome = Mapping[tuple[int, int], float]
"""Successes of a cell by (context, evaluation seed); errors of one without an environment by (trajectory, 0)."""

COMPARISON_COLUMNS = (
    *("task", "label_unit", "demonstrations", "labels", "reference", "method"),
    *("difference", "low", "high", "p", "p_holm", "contexts", "seeds", "n"),
)
REFERENCE = "koap"  # that all other methods are compared with
_FLIPS = 10_000
_RESAMPLES = 4_000
_CHUNK = 500
_TAIL = (1 - 0.95) / 2  # share of the resamples outside the interval at either end


@dataclass(frozen=True)
class Comparison:
    """How much more often the first of two methods succeeds."""

    difference: float  # of the success rates, in -1..1, mean over contexts
    low: float  # ends of its 95 % interval
    high: float
    p: float  # two-sided, of the hypothesis of no difference
    contexts: int  # that both have
    seeds: int  # training seeds that both have
    n: int  # pairs of rollouts behind it


def compare(first: Mapping[int, Outcome], second: Mapping[int, Outcome], *, errors: bool = False) -> Comparison | None:
    r"""Compares two methods on what both have: equal training seed, context and evaluation seed.

    With :math:`d_{sc}` the difference of the successes for training seed s in context c, averaged over rollouts of that
    context, the estimate is the mean over contexts of :math:`\bar d_c`, itself the mean over training seeds.

    The interval resamples contexts *and* training seeds, since a reader wants to know what the next training would
    give. Of S seeds S - 1 are drawn: a resample of all S would understate the variance of their mean by a factor
    (S - 1) / S. With one seed it holds for that one training only. Where every difference is the same, the interval is
    widened by the rule of three, 3 / contexts: what contexts that were not seen could hide.

    The p-value flips signs of :math:`\bar d_c`: for these trained networks, could the advantage be chance of the
    contexts? It says nothing about other training seeds, so it may be small while the interval holds 0.

    Simulated with 60 contexts: where training seeds shift a method's logit of success by a standard deviation of 0.5,
    95 % intervals hold the truth in 94 to 97 % of cases for 2, 3 or 5 seeds (63 % for a single one), and where seeds do
    not matter in more than 99 %. The p-value is below 0.05 in 3 to 6 % of cases without a difference where seeds do not
    matter, but in 27 to 32 % where they do: then the interval is what to go by.

    Either method gives outcomes by training seed. Where these are ``errors``, which have no bounds, a single trajectory
    has no interval (NaN). None is returned if the two share nothing; the same arguments always give the same numbers.
    """
    shared = {seed: first[seed].keys() & second[seed].keys() for seed in first.keys() & second.keys()}
    seeds = sorted(seed for seed, keys in shared.items() if keys)
    if not seeds:
        return None
    contexts = sorted({context for seed in seeds for context, _ in shared[seed]})
    place = {context: index for index, context in enumerate(contexts)}
    total, count = np.zeros((2, len(seeds), len(contexts)))
    for row, seed in enumerate(seeds):
        for key in shared[seed]:
            total[row, place[key[0]]] += float(first[seed][key]) - float(second[seed][key])
            count[row, place[key[0]]] += 1
    there = count > 0
    difference = np.where(there, total / np.maximum(count, 1), 0.0)  # [seeds, contexts]
    per_context = difference.sum(0) / there.sum(0)
    low, high = _interval(difference, there)
    if errors:
        low, high = (low, high) if len(contexts) > 1 else (math.nan, math.nan)
    elif low == high:  # nothing varied: resampling cannot say more, but other contexts could
        reach = min(3 / len(contexts), 1.0)
        low, high = max(low - reach, -1.0), min(high + reach, 1.0)
    return Comparison(
        difference=float(per_context.mean()),
        low=low,
        high=high,
        p=sign_flip_p(per_context),
        contexts=len(contexts),
        seeds=len(seeds),
        n=int(count.sum()),
    )


def _interval(difference: np.ndarray, there: np.ndarray) -> tuple[float, float]:
    """The 95 % interval between percentiles of the mean difference when seeds and contexts are drawn anew."""
    generator = np.random.default_rng(0)
    seeds, contexts = difference.shape
    values = []
    for _ in range(_RESAMPLES // _CHUNK):  # in parts: many contexts would fill the memory
        seed_weight = generator.multinomial(max(seeds - 1, 1), np.full(seeds, 1 / seeds), _CHUNK)
        context_weight = generator.multinomial(contexts, np.full(contexts, 1 / contexts), _CHUNK)
        number = seed_weight @ there.astype(float)  # [draws, contexts]
        mean = seed_weight @ difference / np.maximum(number, 1)
        weight = context_weight * (number > 0)
        drawn = weight.sum(1) > 0
        values.append((weight * mean).sum(1)[drawn] / weight.sum(1)[drawn])
    low, high = np.quantile(np.concatenate(values), [_TAIL, 1 - _TAIL])
    return float(low), float(high)


def sign_flip_p(differences: Sequence[float]) -> float:
    """Two-sided p-value of a mean of 0, from flipping the signs of independent differences, one per context.

    Up to 13 of them all flips are counted; beyond, 10,000 drawn ones, the same in every call, and the observed one
    among them, so that the p-value is never below 2 / 10,001.
    """
    values = np.asarray(differences, dtype=float)
    values = values[values != 0]
    if len(values) < 2:  # a single one may as well be turned round
        return 1.0
    options = {"permutation_type": "samples", "n_resamples": _FLIPS, "vectorized": True, "random_state": 0}
    return float(permutation_test((values,), np.mean, **options).pvalue)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's correction: p-values adjusted so that the chance of any false alarm stays below the level; None stays."""
    order = sorted((index for index, p in enumerate(p_values) if p is not None), key=lambda index: p_values[index])
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def compare_cells(rows: Sequence[Mapping[str, Any]], outcomes: Mapping[str, Outcome]) -> list[dict[str, Any]]:
    """Compares KOAP with every other method at every share of labels, by the outcomes of each cell's ``run``.

    A row of :data:`COMPARISON_COLUMNS` per other method and share is returned. ``difference`` is KOAP's success minus
    the other's (or error, trajectory by trajectory in place of contexts); ``p_holm`` is corrected over all rows; what
    cannot be compared is None. Cells that are not done take no part.
    """
    compared: list[dict[str, Any]] = []
    for place, methods in group_cells(rows).items():
        found: dict[str, dict[int, Outcome]] = {method: {} for method in methods}
        offline = False
        for row in (row for cells in methods.values() for row in cells.values()):
            if row["status"] == "done" and row.get("run") in outcomes:
                found[row["method"]][row["seed"]] = outcomes[row["run"]]
                offline = offline or row.get("kind") == KIND
        for method in methods:
            if REFERENCE in methods and method != REFERENCE:
                result = compare(found[REFERENCE], found[method], errors=offline)
                known = dict(zip(COMPARISON_COLUMNS, (*place, REFERENCE, method), strict=False))
                known |= {"n": 0} if result is None else asdict(result)
                values = {name: known.get(name) for name in COMPARISON_COLUMNS}
                compared.append({name: None if value != value else value for name, value in values.items()})  # NaN
    for row, adjusted in zip(compared, holm([row["p"] for row in compared]), strict=True):
        row["p_holm"] = adjusted
    return compared
