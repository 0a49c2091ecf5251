# This source code is licensed under the MIT license found in the LICENSE file.
"""In which units small values are shown, and which columns may be averaged with each other."""

from __future__ import annotations

from collections.abc import Sequence

_THOUSANDTHS = {"m": "mm", "rad": "mrad", "s": "ms", "N": "mN"}


def thousandths(unit: str) -> tuple[str, float]:
    """Returns the unit in which small values are shown, and the factor to it; metres become millimetres here."""
    return (_THOUSANDTHS[unit], 1e3) if unit in _THOUSANDTHS else (unit, 1.0)


def unit_groups(units: Sequence[str]) -> dict[str, list[int]]:
    """Groups columns by their units, in the order in which the units come."""
    groups: dict[str, list[int]] = {}
    for column, unit in enumerate(units):
        groups.setdefault(unit, []).append(column)
    return groups
