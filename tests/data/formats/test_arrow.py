# This source code is licensed under the MIT license found in the LICENSE file.
"""Columns of parquet files become arrays of numbers."""

import numpy as np
import pytest

from torchrl_koap.data.formats.arrow import number_type, numbers

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra lerobot)")


def column(values, kind):
    array = pa.chunked_array([pa.array(values, kind)])
    return array.cast(number_type(array.type))


@pytest.mark.parametrize("kind", [pa.list_(pa.float32()), pa.large_list(pa.int16()), pa.list_(pa.float32(), 2)])
def test_lists_of_every_kind(kind):
    found = numbers(column([[1, 2], None, [3, 4]], kind), "x")
    np.testing.assert_array_equal(found, [[1, 2], [np.nan, np.nan], [3, 4]])


def test_numbers_and_what_is_none():
    np.testing.assert_array_equal(numbers(column([1, None], pa.int64()), "x"), [[1], [np.nan]])
    assert number_type(pa.string()) is None and number_type(pa.list_(pa.string())) is None


def test_lists_that_are_all_empty_are_as_wide_as_announced():
    assert numbers(column([None, None], pa.list_(pa.float32())), "x", announced=3).shape == (2, 3)


def test_lists_of_other_lengths_are_named():
    with pytest.raises(ValueError, match="b: column 'x' has rows of 1 and 2 numbers"):
        numbers(column([[1, 2], [3]], pa.list_(pa.float32())), "x", files=["a", "b"])
