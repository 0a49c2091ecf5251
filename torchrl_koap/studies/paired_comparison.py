# This source code is licensed under the MIT license found in the LICENSE file.
"""Is one method better than another? Compares their successes in pairs, on the same evaluation contexts.

Two methods that were evaluated on the same contexts with the same seeds are compared context by context: hard contexts
are hard for both, and the difference cancels what is common to both.
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
REFERENCE = "koap"  # all other methods are compared with it
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
    contexts: int  # common to both
    seeds: int  # training seeds common to both
    n: int  # compared pairs of rollouts


def compare(first: Mapping[int, Outcome], second: Mapping[int, Outcome], *, errors: bool = False) -> Comparison | None:
    r"""Compares two methods on the rollouts of equal training seed, context and evaluation seed.

    Let :math:`d_{sc}` be the difference of the successes for training seed s in context c, averaged over rollouts of
    that context, and :math:`\bar d_c` its mean over training seeds. The estimate is the mean of :math:`\bar d_c`.

    The interval resamples contexts *and* training seeds, as it should cover a further training. Of S seeds, S - 1 are
    drawn: a resample of all S would understate the variance of their mean by a factor (S - 1) / S. With one seed, the
    interval holds for that training only. If all differences are equal, the interval is widened by the rule of three,
    3 / contexts, for contexts that were not seen.

    The p-value flips signs of :math:`\bar d_c`. It tests whether the choice of contexts explains the advantage of
    these trained networks. It ignores other training seeds, so it may be small while the interval contains 0.

    Simulated with 60 contexts: if training seeds shift a method's logit of success by a standard deviation of 0.5,
    95 % intervals contain the truth in 94 to 97 % of cases for 2, 3 or 5 seeds (63 % for a single one); if seeds do
    not matter, in more than 99 %. Without a true difference, the p-value is below 0.05 in 3 to 6 % of cases if seeds do
    not matter, but in 27 to 32 % if they do: then rely on the interval.

    Both methods have outcomes by training seed. With ``errors``, which are unbounded, a single trajectory has no
    interval (NaN). Returns None if the two share nothing. The same arguments always give the same numbers.
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
            total[row, place[key[0]]] += first[seed][key] - second[seed][key]
            count[row, place[key[0]]] += 1
    there = count > 0
    difference = np.where(there, total / np.maximum(count, 1), 0.0)  # [seeds, contexts]
    per_context = difference.sum(0) / there.sum(0)
    low, high = _interval(difference, there)
    if errors:
        low, high = (low, high) if len(contexts) > 1 else (math.nan, math.nan)
    elif low == high:  # nothing varied, but unseen contexts could: rule of three
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
    """Returns the 95 % percentile interval of the mean difference under resampling of seeds and contexts."""
    generator = np.random.default_rng(0)
    seeds, contexts = difference.shape
    values = []
    for _ in range(_RESAMPLES // _CHUNK):  # in chunks, as many contexts would fill the memory
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
    """Returns the two-sided p-value of a mean of 0, by flipping signs of independent differences, one per context.

    For up to 13 differences all flips are counted, else 10,000 random ones (the same in every call) and the observed
    one, so that the p-value is never below 2 / 10,001.
    """
    values = np.asarray(differences, dtype=float)
    values = values[values != 0]
    if len(values) < 2:  # either sign of a single difference is equally likely
        return 1.0
    options = {"permutation_type": "samples", "n_resamples": _FLIPS, "vectorized": True, "random_state": 0}
    return float(permutation_test((values,), np.mean, **options).pvalue)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Adjusts p-values by Holm's method, which bounds the chance of any false positive by the level; keeps None."""
    order = sorted((index for index, p in enumerate(p_values) if p is not None), key=lambda index: p_values[index])
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def compare_cells(rows: Sequence[Mapping[str, Any]], outcomes: Mapping[str, Outcome]) -> list[dict[str, Any]]:
    """Compares KOAP with every other method at every share of labels, by the outcomes of each cell's ``run``.

    Returns a row of :data:`COMPARISON_COLUMNS` per other method and share. ``difference`` is KOAP's success minus the
    other's (or errors, with trajectories as contexts). ``p_holm`` is corrected over all rows. Entries that cannot be
    compared are None. Cells that are not done are ignored.
    """
    compared: list[dict[str, Any]] = []
    for place, methods in group_cells(rows).items():
        done = [row for cells in methods.values() for row in cells.values() if row["status"] == "done"]
        offline = any(row.get("kind") == KIND for row in done)
        found: dict[str, dict[int, Outcome]] = {method: {} for method in methods}
        for row in done:
            if row.get("run") in outcomes:
                found[row["method"]][row["seed"]] = outcomes[row["run"]]
        reference = found.pop(REFERENCE, None)
        for method in () if reference is None else found:
            result = compare(reference, found[method], errors=offline)
            known = dict(zip(COMPARISON_COLUMNS, (*place, REFERENCE, method), strict=False))
            known |= {"n": 0} if result is None else asdict(result)
            values = {name: known.get(name) for name in COMPARISON_COLUMNS}
            compared.append({name: None if value != value else value for name, value in values.items()})  # NaN
    for row, adjusted in zip(compared, holm([row["p"] for row in compared]), strict=True):
        row["p_holm"] = adjusted
    return compared
