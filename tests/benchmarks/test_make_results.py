# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that pages of results match the committed figures; tests/docs/test_results_form.py tests their form."""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "benchmarks" / "results"
BY_HAND = {"appendix": {"d3il.md"}}  # facts of the simulator, which no figure makes


@pytest.fixture(scope="module")
def results(benchmark_script):
    return benchmark_script("make_results")


def test_pages_are_those_of_the_figures(results):
    pages = results.pages()
    assert Path("README.md") in pages and len(pages) >= 8
    for path, text in pages.items():
        assert (ROOT / path).read_text() == text, f"{path}: run python benchmarks/make_results.py"
    for folder in ("results", "appendix"):
        made = {path.name for path in pages if path.parent.name == folder}
        assert {path.name for path in (ROOT / "docs" / folder).iterdir()} == made | BY_HAND.get(folder, set())


def test_figures_of_the_readme_are_those_of_the_cells():
    """Read back independently of the generator: successes, n and a Wilson interval from its formula."""
    readme = (ROOT / "README.md").read_text()
    cells = list(csv.DictReader((SOURCE / "cells" / "table_1.csv").open()))
    names = {"Avoiding": "avoiding", "Aligning": "aligning", "Sorting": "sorting"}
    methods = ("koap", "koap_untrained", "linear_steps", "dd", "dp")
    lines = re.findall(r"^\| (\w+) \| (\d+) % \|(.*)\|$", readme, re.MULTILINE)
    assert {name for name, *_ in lines} == set(names)
    for name, percent, rest in lines:
        for method, text in zip(methods, rest.split("|"), strict=False):
            wanted = (names[name], method, int(percent) / 100)
            mine = [row for row in cells if (row["task"], row["method"], float(row["labels"])) == wanted]
            successes, n = (sum(int(row[key]) for row in mine) for key in ("successes", "episodes"))
            low, high = wilson(successes, n)
            assert text.strip() == f"{100 * successes / n:.0f} ({100 * low:.0f}-{100 * high:.0f})"
    with (SOURCE / "facts.csv").open() as file:
        rows = {row["key"]: row for row in csv.DictReader(file)}
    facts = {key: f"{row['value']} {row['unit']}".strip() for key, row in rows.items()}
    assert f"The demo takes {facts['demo_total']}." in readme and f"about {facts['own_data_fit']} on" in readme
    successes, n = (int(rows["demo_success"][key]) for key in ("successes", "n"))
    low, high = wilson(successes, n)
    shown = f"{successes} of {n} rollouts ({100 * successes / n:.1f} % ({100 * low:.1f}-{100 * high:.1f}))"
    assert shown in readme and f"is {facts['demo_entropy']} of 1" in readme


def wilson(successes, n, z=1.959963984540054):
    rate, weight = successes / n, z * z / n
    centre = (rate + weight / 2) / (1 + weight)
    spread = z / (1 + weight) * (rate * (1 - rate) / n + weight / (4 * n)) ** 0.5
    return centre - spread, centre + spread


@pytest.mark.parametrize("path", sorted(SOURCE.glob("*.csv")), ids=lambda path: path.stem)
def test_rows_are_complete_and_within_range(path):
    """Every row has all columns; successes lie within n, means within their range, and each comes from a command."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file, restkey="more", restval=None, strict=True))
    assert rows
    for row in rows:
        assert "more" not in row and None not in row.values()
        if row.get("successes"):
            assert 0 <= int(row["successes"]) <= int(row["n"])
        if row.get("entropy"):
            assert 0 <= float(row["entropy"]) <= 1
        if row.get("low") and (mean := row.get("error") or row.get("difference") or row.get("median")):
            assert float(row["low"]) <= float(mean) <= float(row["high"])
        if "command" in row and path.stem != "ablations":
            assert row["command"]
