# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests report and pictures of a curve: written with missing parts, correct comparisons, escaping."""

import random
import re

import pytest
from html_pages import Page
from PIL import Image
from tiny_runs import read_csv

from torchrl_koap.studies import report
from torchrl_koap.studies.report import write_study_report
from torchrl_koap.studies.table import summarise

_METHODS = {"koap": 0.9, "ridge": 0.6, "vae": 0.4}


def make_cells(outcomes: dict | None = None, *, methods=_METHODS, labels=(0.01, 0.1), seeds=2, episodes=20, **more):
    rows = []
    for method, rate in methods.items():
        for share in labels:
            for seed in range(seeds):
                generator = random.Random(f"{method} {share} {seed}")
                won = [generator.random() < rate for _ in range(episodes)]
                row = {"task": "avoiding", "method": method, "labels": share, "demonstrations": 1.0, "seed": seed}
                row |= {"label_unit": "trajectory", "status": "done", "reason": "", "mode_entropy": 0.5}
                row |= {"labelled_transitions": 9000 * share, "action_error": 1 / rate + seed}
                row |= {"episodes": episodes, "successes": sum(won)}
                row |= {"train_seconds": 60.0, "eval_seconds": 5.0, **more}
                row["run"] = f"{row['task']}/{method}/{share}/{row['demonstrations']}/{seed}"
                rows.append(row)
                if outcomes is not None:
                    outcomes[row["run"]] = {(n, 100 + n): float(good) for n, good in enumerate(won)}
    return rows


def spoil(row, status, reason=""):
    row.update(status=status, reason=reason, episodes=None, successes=None, action_error=None, train_seconds=None)


def read_comparisons(folder):
    return read_csv(folder / "comparisons.csv")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    rows = make_cells(outcomes := {})
    spoil(rows[0], "failed", "RuntimeError: <loss> is not\nfinite")
    spoil(rows[5], "missing")
    options = {"planner.steps": 12345}
    path = write_study_report(folder, rows, outcomes, title="Labels & success", options=options)
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
        "One planner is shared by all cells that plan, for each task, share of the trajectories and seed.",
        "The seeds vary planner, controller and labels.",
        "resamples both contexts and training seeds",
    ):
        assert wanted in text


def test_contexts_do_not_recur_in_an_environment_of_gymnasium(tmp_path):
    rows = make_cells(outcomes := {})
    own, other = (
        Page(write_study_report(tmp_path, rows, outcomes, title="t", options={"evaluation": options})).text
        for options in ({"episodes": 20}, {"env": "mine:Reach-v0"})
    )
    words = ("rolled out on fixed evaluation contexts", "contexts recur", "on the same contexts")
    assert all(word in own and word not in other for word in words)
    assert "rolled out in mine:Reach-v0. " in other and "every episode is a context below. The" in other


def test_the_paper_stands_beside_labelled_windows(tmp_path):
    rows = make_cells(outcomes := {}, labels=(0.02, 0.1), label_unit="window")
    text = Page(write_study_report(tmp_path, rows, outcomes, title="t")).text
    assert re.search(r"avoiding 3 \(10 %\) \d+\.\d \(\d+-\d+\) \[97\.2 \+- \d\.\d\]", text)
    assert "Hollow, dashed: the paper" in text and re.search("in [12] of 2 cells", text)
    assert (tmp_path / "paper_table.md").exists()
    absent = {"ridge": 0.6}  # not in the paper
    own = make_cells(outcomes := {}, methods=absent, labels=(0.02, 0.1), label_unit="window")
    assert "Hollow" not in Page(write_study_report(tmp_path, own, outcomes, title="t")).text


def test_pictures_exist_and_nothing_comes_from_elsewhere(folder):
    links = Page(folder / "index.html").links
    names = ("success", "mode_entropy", "action_error")
    assert {f"plots/avoiding_{name}.png" for name in names} == set(links)
    assert {path.name for path in (folder / "plots").iterdir()} == {link.removeprefix("plots/") for link in links}
    for link in links:
        width, height = Image.open(folder / link).size
        assert width > 700 and height > 500


def test_table_and_comparisons_are_files_too(folder):
    assert "2 of 12 cells are not done:" in (folder / "table.md").read_text()
    rows = read_comparisons(folder)
    assert [(row["labels"], row["method"]) for row in rows] == [
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
    rows = make_cells(outcomes := {})
    write_study_report(tmp_path, rows, outcomes, title="t")
    found = {(row["labels"], row["method"]): float(row["difference"]) for row in read_comparisons(tmp_path)}
    pooled = {(item.labels, item.method): item.mean("success") for item in summarise(rows)}
    for (labels, method), difference in found.items():
        assert difference == pytest.approx(pooled[float(labels), "koap"] - pooled[float(labels), method])
    assert len(found) == 4


def test_cells_without_outcomes_are_not_compared(tmp_path):
    rows = make_cells(outcomes := {})
    text = Page(write_study_report(tmp_path, rows, dict(list(outcomes.items())[2:]), title="t")).text
    nothing = [row for row in read_comparisons(tmp_path) if row["labels"] == "0.01"]
    assert [(row["n"], row["p"], row["p_holm"]) for row in nothing] == [("0", "", "")] * 2
    assert "no common rollouts" in text


def test_report_without_any_done_cell(tmp_path):
    rows = make_cells()
    for row in rows:
        spoil(row, "missing")
    text = Page(write_study_report(tmp_path, rows, title="t")).text
    assert "Nothing to draw: no cell is done." in text
    assert "no cell done" in text
    assert not (tmp_path / "plots").exists()
    assert "No cells." in Page(write_study_report(tmp_path, [], title="t")).text


def test_reference_that_was_not_run_is_said(tmp_path):
    text = Page(write_study_report(tmp_path, make_cells(methods={"vae": 0.5}), title="t")).text
    assert "koap was not run" in text
    assert read_comparisons(tmp_path) == []


def test_shares_of_demonstrations_and_tasks_have_their_own_pictures(tmp_path):
    outcomes = {}
    rows = [row for share in (0.25, 1.0) for row in make_cells(outcomes, demonstrations=share, seeds=1)]
    rows += make_cells(outcomes, task="stacking_1", seeds=1)
    page = Page(write_study_report(tmp_path, rows, outcomes, title="t"))
    wanted = ("avoiding_success", "avoiding_demonstrations", "stacking_1_success", "stacking_1_action_error")
    assert {f"plots/{name}.png" for name in wanted} <= set(page.links)
    assert "plots/stacking_1_demonstrations.png" not in page.links
    assert len(read_comparisons(tmp_path)) == 2 * 2 * 3


def test_success_and_errors_of_one_study_are_told_apart(tmp_path):
    outcomes, recorded = {}, {"kind": "offline", "episodes": None, "successes": None, "relative_action_error": 0.3}
    rows = make_cells(outcomes, seeds=1) + [row | recorded for row in make_cells(outcomes, task="arm", seeds=1)]
    text = Page(write_study_report(tmp_path, rows, outcomes, title="t")).text
    assert "success above 0: koap succeeds more often. Difference of errors below 0: koap errs less." in text
    assert "evaluated on recorded data or rolled out on fixed evaluation contexts." in text
    assert "avoiding 1 % ridge +30.0 +0.0 to +60.0" in text and "arm 1 % ridge – +0.000 to +0.600" in text


def test_the_unit_of_the_errors_does_not_depend_on_the_first_cell(monkeypatch, tmp_path):
    rows, units = make_cells(seeds=1, action_error_unit="mm"), {}
    spoil(rows[0], "failed")
    rows[0]["action_error_unit"] = None
    monkeypatch.setattr(report, "plot_measure", lambda _, path, kind, **more: units.update({kind: more.get("unit")}))
    write_study_report(tmp_path, rows, title="t")
    assert units["action_error"] == "mm"


def test_errors_at_different_shares_of_labels_are_of_different_recordings(tmp_path):
    page = write_study_report(tmp_path, make_cells(seeds=1, relative_action_error=0.5), title="curve").read_text()
    assert "compare methods at one share, not shares of labels" in page
