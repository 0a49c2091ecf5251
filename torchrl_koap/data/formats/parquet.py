# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads columns of parquet files as numbers, for all readers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_koap.lookup import import_extra


def import_pyarrow() -> Any:
    """Imports pyarrow."""
    import_extra("pyarrow", "lerobot", "parquet files and LeRobot data sets need")
    import pyarrow
    import pyarrow.compute
    import pyarrow.dataset
    import pyarrow.parquet

    return pyarrow


def number_type(kind: Any) -> Any:
    """Returns the pyarrow type to read a column of numbers, or of lists of numbers, as; None for other columns."""
    pyarrow = import_pyarrow()
    types = pyarrow.types
    nested = types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
    inner = kind.value_type if nested else kind
    known = (types.is_floating, types.is_integer, types.is_boolean, types.is_decimal)
    if not any(is_one(inner) for is_one in known):
        return None
    return pyarrow.list_(pyarrow.float64()) if nested else pyarrow.float64()


def numbers(column: Any, name: str, *, announced: int = 1, files: Sequence[str] | None = None) -> np.ndarray:
    """Returns a column with a type of :func:`number_type` as float64 ``[rows, width]``; empty rows are NaN.

    ``announced`` is the width if all lists are empty; ``files`` holds the file of every row, for messages.
    """
    pyarrow, column = import_pyarrow(), column.combine_chunks()
    if not pyarrow.types.is_list(column.type):
        return column.to_numpy(zero_copy_only=False).reshape(-1, 1)
    there = column.is_valid().to_numpy(zero_copy_only=False)
    sizes = pyarrow.compute.list_value_length(column).drop_null().to_numpy()
    widths = np.unique(sizes)
    if len(widths) > 1 or 0 in widths:
        odd = int(np.flatnonzero(there)[(sizes != sizes[0]).argmax()])
        where = "" if files is None else f"{files[odd]}: "
        counts = " and ".join(map(str, widths))
        raise ValueError(f"{where}column {name!r} has rows of {counts} numbers, wanted the same number in all")
    values = np.full((len(column), int(widths[0]) if len(widths) else max(announced, 1)), np.nan)
    if len(widths):
        values[there] = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, values.shape[1])
    return values
