# This source code is licensed under the MIT license found in the LICENSE file.
"""Report and pictures of a curve: written whatever is absent, right comparisons, everything said and escaped."""

from __future__ import annotations

import csv
import json
import random
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from torchrl_koap.studies.lines import _spread, method_styles
from torchrl_koap.studies.plots import plot_action_error, plot_entropy, plot_success
from torchrl_koap.studies.report import write_curve_report
from torchrl_koap.studies.summary import summarise

_VOID = {"meta", "img"}
_METHODS = {"koap": 0.9, "ridge": 0.6, "vae": 0.4}


class Page(HTMLParser):
    """Text and links of a page; fails on tags that do not close."""

    def __init__(self, path):
        super().__init__()
        self.open, self.links, self.words = [], [], []
        self.feed(path.read_text())
        assert not self.open, f"not closed: {self.open}"
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attributes):
        self.links += [value for name, value in attributes if name in ("src", "href")]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in _VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)


def make_cells(folder: Path | None, *, methods=_METHODS, fractions=(0.01, 0.1), seeds=2, episodes=20, **more):
    """Rows, and their evaluations below the folder if there is one."""
    rows = []
    for method, rate in methods.items():
        for fraction in fractions:
            for seed in range(seeds):
                generator = random.Random(f"{method} {fraction} {seed}")
                won = [generator.random() < rate for _ in range(episodes)]
                row = {"task": "avoiding", "method": method, "fraction": fraction, "observations": 1.0, "seed": seed}
                row |= {
                    "label_unit": "trajectory",
                    "status": "done",
                    "reason": "",
                    "labelled_transitions": 9000 * fraction,
                }
                row |= {
                    "episodes": episodes,
                    "successes": sum(won),
                    "action_error": 1 / rate + seed,
                    "mode_entropy": 0.5,
                }
                row |= {"train_seconds": 60.0, "eval_seconds": 5.0, **more}
                row["run"] = f"{row['task']}/{method}/{fraction}/{row['observations']}/{seed}"
                rows.append(row)
                if folder is not None:
                    (folder / row["run"]).mkdir(parents=True)
                    episode = [
                        {
                            "seed": 100 + n,
                            "context": n,
                            "outcome": "success" if good else "timeout",
                            "mode": 0,
                            "steps": 9,
                        }
                        for n, good in enumerate(won)
                    ]
                    (folder / row["run"] / "eval.json").write_text(json.dumps({"episode": episode}))
    return rows


def spoil(row, status, reason=""):
    row.update(status=status, reason=reason, episodes=None, successes=None, action_error=None, train_seconds=None)


def read_comparisons(folder):
    with (folder / "comparisons.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("curve")
    rows = make_cells(folder)
    spoil(rows[0], "failed", "RuntimeError: <loss> is not\nfinite")
    spoil(rows[5], "missing")
    (folder / "curve.json").write_text(json.dumps({"planner_steps": 12345}))
    paper = [
        {"task": "avoiding", "method": "koap", "fraction": 0.1, "success": 0.92},
        {"task": "avoiding", "method": "ridge", "fraction": 0.25, "success": 0.5},
    ]
    path = write_curve_report(folder, rows, title="Labels & success", paper=paper)
    assert path == folder / "index.html"
    return folder


def test_page_says_what_was_run_and_what_was_not(folder):
    text = Page(folder / "index.html").text
    for wanted in (
        "Labels & success",
        "avoiding: methods koap, ridge, vae, labels on 1 %, 10 % of the trajectories, training seeds 0, 1.",
        "Of 12 cells 10 are done; failed: 1, missing: 1.",
        "12,345",
        "avoiding, koap, 1 % labels, seed 0: failed: RuntimeError: <loss> is not finite",
        "avoiding, ridge, 1 % labels, seed 1: missing",
        "1 of 2",
        "One planner is shared by all cells that plan",
        "resamples contexts and training seeds",
        "All cells together: 10 min 50 s",  # ten times 60 + 5 s
    ):
        assert wanted in text


def test_paper_stands_beside_what_was_measured(folder):
    text = Page(folder / "index.html").text
    assert re.search(r"koap 10 % 92\.0 \d+\.\d % \(", text)
    assert "ridge 25 % 50.0 not run" in text


def test_pictures_exist_and_nothing_comes_from_elsewhere(folder):
    links = Page(folder / "index.html").links
    names = ("success", "entropy", "action_error")
    assert {f"plots/avoiding_{name}.png" for name in names} == set(links)
    names = {path.name for path in (folder / "plots").iterdir()}
    ways = ("success", "success_labels", "success_transitions", "entropy", "action_error")
    assert names == {f"avoiding_{way}.png" for way in ways}
    for path in (folder / "plots").iterdir():
        width, height = Image.open(path).size
        assert width > 700
        assert height > 500


def test_table_and_comparisons_are_files_too(folder):
    assert "2 of 12 cells are not done:" in (folder / "table.md").read_text()
    rows = read_comparisons(folder)
    assert [(row["fraction"], row["method"]) for row in rows] == [
        ("0.01", "ridge"), ("0.01", "vae"), ("0.1", "ridge"), ("0.1", "vae")
    ]  # fmt: skip
    assert all(row["reference"] == "koap" for row in rows)
    assert (rows[0]["n"], rows[0]["difference"], rows[0]["p_holm"]) == ("0", "", "")  # koap has seed 1, ridge seed 0
    for row in rows[1:]:
        assert float(row["low"]) <= float(row["difference"]) <= float(row["high"])
        assert float(row["p"]) <= float(row["p_holm"]) <= 1
    assert (rows[1]["n"], rows[1]["seeds"]) == ("20", "1")
    assert (rows[3]["n"], rows[3]["seeds"], rows[3]["contexts"]) == ("40", "2", "20")
    assert float(rows[3]["difference"]) > 0.2


def test_differences_are_those_of_the_cells(tmp_path):
    rows = make_cells(tmp_path)
    write_curve_report(tmp_path, rows, title="t", reference="vae")
    found = {(row["fraction"], row["method"]): float(row["difference"]) for row in read_comparisons(tmp_path)}
    pooled = {(item.fraction, item.method): item.success for item in summarise(rows)}
    for (fraction, method), difference in found.items():
        expected = pooled[float(fraction), "vae"] - pooled[float(fraction), method]
        assert difference == pytest.approx(expected)
    assert len(found) == 4


def test_damaged_and_absent_evaluations_are_said(tmp_path):
    rows = make_cells(tmp_path)
    (tmp_path / rows[0]["run"] / "eval.json").write_text("{")
    (tmp_path / rows[1]["run"] / "eval.json").unlink()
    (tmp_path / "curve.json").write_text("[1]")
    text = Page(write_curve_report(tmp_path, rows, title="t")).text
    assert text.count("left out of the paired comparisons") == 2
    for name in (f"{rows[0]['run']}/eval.json is damaged", f"{rows[1]['run']}/eval.json", "curve.json is damaged"):
        assert name in text
    nothing = [row for row in read_comparisons(tmp_path) if row["fraction"] == "0.01"]
    assert [(row["n"], row["p"], row["p_holm"]) for row in nothing] == [("0", "", "")] * 2
    assert "nothing in common" in text


def test_report_without_any_done_cell(tmp_path):
    rows = make_cells(None)
    for row in rows:
        spoil(row, "missing")
    text = Page(write_curve_report(tmp_path, rows, title="t")).text
    assert "Nothing to draw: no cell is done." in text
    assert "no cell done" in text
    assert not (tmp_path / "plots").exists()
    assert "No cells." in Page(write_curve_report(tmp_path, [], title="t")).text


def test_reference_that_was_not_run_is_said(tmp_path):
    text = Page(write_curve_report(tmp_path, make_cells(tmp_path, methods={"vae": 0.5}), title="t")).text
    assert "koap was not run" in text
    assert read_comparisons(tmp_path) == []


def test_shares_of_trajectories_and_tasks_have_their_own_pictures(tmp_path):
    rows = [row for share in (0.25, 1.0) for row in make_cells(tmp_path, observations=share, seeds=1)]
    rows += make_cells(tmp_path, task="stacking_1", seeds=1)
    page = Page(write_curve_report(tmp_path, rows, title="t"))
    wanted = ("avoiding_success", "avoiding_observations", "stacking_1_success", "stacking_1_action_error")
    assert {f"plots/{name}.png" for name in wanted} <= set(page.links)
    assert "plots/stacking_1_observations.png" not in page.links
    assert len(read_comparisons(tmp_path)) == 2 * 2 * 3


def test_names_of_methods_do_not_overlap():
    for wanted in ([0.9] * 8, [0.0, 0.01, 0.5, 0.5, 1.0], [-0.2, 1.3], [0.5]):
        places = _spread(wanted, 0.05)
        assert all(b - a >= 0.05 - 1e-9 for a, b in zip(places, places[1:], strict=False))
        assert places[0] >= 0
        assert places[-1] <= 1
    assert _spread([0.2, 0.6], 0.05) == [0.2, 0.6]
    assert _spread([0.5, 0.5], 0.1) == pytest.approx([0.45, 0.55])


def test_twelve_methods_differ_without_colour():
    styles = method_styles([f"method {number}" for number in range(12)])
    assert len({style["marker"] for style in styles.values()}) == 12
    assert len({(style["color"], style["dash"]) for style in styles.values()}) == 12


def test_pictures_of_few_points(tmp_path):
    single = summarise(make_cells(None, fractions=(0.05,), seeds=1))
    assert plot_success(single, tmp_path / "single.png").exists()
    nothing = make_cells(None, fractions=(0.0, 0.1))  # no label at all has its place on a logarithmic axis
    assert plot_success(summarise(nothing), tmp_path / "zero.png").exists()
    many = {f"method {number}": 0.5 for number in range(12)}
    assert plot_action_error(summarise(make_cells(None, methods=many)), tmp_path / "many.png", unit="mm").exists()


def test_pictures_of_nothing_are_refused(tmp_path):
    rows = make_cells(None, seeds=1)
    for row in rows:
        spoil(row, "failed")
    with pytest.raises(ValueError, match="no cell is done"):
        plot_success(summarise(rows), tmp_path / "a.png")
    with pytest.raises(ValueError, match="no action error"):
        plot_action_error(summarise(rows), tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def test_entropy_is_drawn_from_best_to_worst_seed(tmp_path):
    rows = make_cells(None)
    for row in rows:
        row["mode_entropy"] = 0.2 * row["seed"]
    items = [item for item in summarise(rows) if item.entropy is not None]
    assert items and all(
        item.entropy_low == 0 and item.entropy_high == pytest.approx(0.2 * max(item.done)) for item in items
    )
    assert plot_entropy(items, tmp_path / "entropy.png").stat().st_size > 5000
    for row in rows:
        row["mode_entropy"] = None
    with pytest.raises(ValueError, match="no entropy to draw"):
        plot_entropy(summarise(rows), tmp_path / "none.png")
