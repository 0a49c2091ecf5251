# This source code is licensed under the MIT license found in the LICENSE file.
"""Rows of the tables on unlabelled data: errors by method and labels, gains paired by seed."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence

from result_rows import percent, read_rows
from scipy.stats import t as student
from unlabelled_picture import CONTROLS, PLAYED, REGIMES

TITLES = REGIMES | PLAYED
LABELS = (1, 2, 4, 8, 16)  # labelled trajectories of the whole study


def unlabelled_cells(regime: str) -> dict[tuple[str, int], dict[int, float]]:
    """Action errors of a regime by method and number of labelled trajectories, then by seed."""
    return _by_cell("unlabelled_data", regime, lambda row: float(row["error"]))


def unlabelled_successes(regime: str) -> dict[tuple[str, int], dict[int, float]]:
    """Shares of rollouts of a regime that succeed, by method and number of labelled trajectories, then by seed."""
    return _by_cell("unlabelled_rollouts", regime, _successes)


def _by_cell(
    name: str, regime: str, value: Callable[[Mapping[str, str]], float]
) -> dict[tuple[str, int], dict[int, float]]:
    found: dict[tuple[str, int], dict[int, float]] = {}
    for row in read_rows(name, regime=regime):
        found.setdefault((row["method"], int(row["labels"])), {})[int(row["seed"])] = value(row)
    return found


def unlabelled_rows(regime: str) -> list[list[str]]:
    """A row per method of a regime: mean error and range over seeds for every number of labelled trajectories."""
    cells = unlabelled_cells(regime)
    labels = sorted({number for _, number in cells})
    body = []
    for method in dict.fromkeys(method for method, _ in cells):
        row = [f"`{method}`"]
        for number in labels:
            errors = list(cells.get((method, number), {}).values())
            ends = f"{min(errors):.2f}-{max(errors):.2f}, {len(errors)} seeds" if errors else ""
            row.append(f"{statistics.fmean(errors):.2f} ({ends})" if errors else "not run")
        body.append(row)
    return body


def unlabelled_labels(regime: str) -> list[str]:
    """Headings of :func:`unlabelled_rows`."""
    return [f"{number} labelled" for number in sorted({number for _, number in unlabelled_cells(regime)})]


def unlabelled_missing() -> str:
    """What the study's table has no row of: methods, and for each the regimes and numbers of labelled trajectories."""
    missing: list[str] = []
    cells = {title: unlabelled_cells(regime) for regime, title in REGIMES.items()}
    for method in CONTROLS:
        places: dict[str, list[str]] = {}  # regimes by the numbers that they lack
        for title, known in cells.items():
            lacks = [str(number) for number in LABELS if (method, number) not in known]
            if lacks:
                places.setdefault("" if len(lacks) == len(LABELS) else f"with {' or '.join(lacks)}: ", []).append(title)
        found = [f"{numbers}{'; '.join(titles)}" for numbers, titles in sorted(places.items())]
        missing += [f"* `{method}`: {'. '.join(found)}"] if found else []
    return "\n".join(missing) or "* nothing"


def unlabelled_gains(regimes: Sequence[str], against: Sequence[str]) -> list[list[str]]:
    """How much smaller the error of ``semi_supervised`` is, in percent, paired by seed, with a 95 % t-interval."""
    body = []
    for regime in regimes:
        cells = unlabelled_cells(regime)
        for number in sorted({number for _, number in cells}):
            row = [TITLES[regime], str(number)]
            for method in against:
                own, other = (cells.get((name, number), {}) for name in ("semi_supervised", method))
                row.append(paired_gain([100 * (1 - own[seed] / other[seed]) for seed in own.keys() & other.keys()]))
            body.append(row)
    return body


def followed_rows(against: Sequence[str], *, played: bool = False) -> list[list[str]]:
    """Successes of controllers that follow demonstrations not seen before, and how much ``semi_supervised`` is ahead.

    Args:
        against (sequence of str): methods that it is compared with.

    Keyword Args:
        played (bool): where the labels are from random play, instead of from demonstrations.
    """
    found = _followed(played)
    body = []
    for (regime, labels), methods in found.items():
        own = methods.get("semi_supervised")
        if not own:
            continue
        row = [TITLES[regime], str(labels), _together(own)]
        for method in against:
            other = methods.get(method, {})
            ahead = [100 * (_successes(own[seed]) - _successes(other[seed])) for seed in own.keys() & other.keys()]
            row += [_together(other) if other else "not run", paired_gain(ahead, unit="points")]
        body.append(row)
    return body


def followed_beside(methods: Sequence[str]) -> list[list[str]]:
    """Successes alone, of methods that :func:`followed_rows` does not compare with.

    Args:
        methods (sequence of str): the methods.
    """
    return [
        [TITLES[regime], str(labels), *(_together(own[name]) if name in own else "not run" for name in methods)]
        for (regime, labels), own in _followed(played=False).items()
    ]


def _followed(played: bool) -> dict[tuple[str, int], dict[str, dict[int, dict]]]:
    """Rows of rollouts by regime and number of labelled trajectories, then by method, then by seed."""
    found: dict[tuple[str, int], dict[str, dict[int, dict]]] = {}
    for row in read_rows("unlabelled_rollouts"):
        if (row["regime"] in PLAYED) == played:
            cell = found.setdefault((row["regime"], int(row["labels"])), {})
            cell.setdefault(row["method"], {})[int(row["seed"])] = row
    return dict(sorted(found.items(), key=lambda item: (list(TITLES).index(item[0][0]), item[0][1])))


def followed(regime: str, labels: int, method: str) -> str:
    """How often demonstrations not seen before were followed to the end, over all seeds.

    Args:
        regime (str): the regime.
        labels (int): labelled trajectories.
        method (str): the method.
    """
    rows = read_rows("unlabelled_rollouts", regime=regime, labels=labels, method=method)
    return _together({int(row["seed"]): row for row in rows})


def _together(seeds: dict[int, dict]) -> str:
    counts = {key: str(sum(int(row[key]) for row in seeds.values())) for key in ("successes", "n")}
    return f"{percent(counts, 0)} of {counts['n']}"


def _successes(row: dict) -> float:
    return int(row["successes"]) / int(row["n"])


def paired_gain(gains: Sequence[float], unit: str = "%") -> str:
    """Mean of some gains in percent with its 95 % t-interval; no interval below three.

    Args:
        gains (sequence of float): one per seed.
        unit (str): what they are called, such as percentage ``"points"``.
    """
    if len(gains) < 3:
        return f"{statistics.fmean(gains):+.0f} {unit} ({len(gains)} seeds)" if gains else "not run"
    half = student.ppf(0.975, len(gains) - 1) * statistics.stdev(gains) / len(gains) ** 0.5
    mean = statistics.fmean(gains)
    return f"{mean:+.0f} {unit} ({mean - half:+.0f} to {mean + half:+.0f})"
