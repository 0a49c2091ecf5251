# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests tables of committed cells, and that methods declare their tuned settings."""


def cell(method, fraction, successes):
    done = {"task": "avoiding", "demonstrations": 1.0, "seed": 0, "label_unit": "window", "status": "done"}
    return done | {"method": method, "labels": fraction, "episodes": 60, "successes": successes}


def test_cells_above_the_paper_are_counted(benchmark_script, monkeypatch):
    """Other rows are compared with the committed pages by test_make_results.py."""
    rows = benchmark_script("paper_rows")
    cells = [cell("koap", 0.02, 60), cell("pca", 0.02, 60), cell("koap", 0.05, 40)]  # the paper: 78.0 and 98.05 %
    monkeypatch.setattr(rows, "read_cells", {"made": cells}.__getitem__)
    assert rows.bench_sentence("made") == "1 of 2"


def test_methods_declare_what_the_tuning_found(benchmark_script):
    """The best setting, or one that scores as well within the error of 180 rollouts."""
    rows = benchmark_script("paper_rows")
    methods = {row["method"] for row in rows.read_rows("method_tuning")}
    assert {"koap", "dd", "vae", "lapo", "linear"} <= methods
    for method in methods:
        best = rows.tuned_settings(method)[0]
        assert rows.declared_setting(method).score >= best.score - 0.03, f"{method}: {best} is better"
