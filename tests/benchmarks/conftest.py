# This source code is licensed under the MIT license found in the LICENSE file.
"""Puts ``benchmarks`` on the import path, since its scripts import each other by name."""

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def benchmark_script():
    """Returns a function that imports a script of ``benchmarks`` by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield importlib.import_module
