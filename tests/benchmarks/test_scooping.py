# This source code is licensed under the MIT license found in the LICENSE file.
"""The study of Scooping: options, rows, tables, probe, outlines and cost, with planted answers."""

from __future__ import annotations

import csv
import json

import pytest


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--methods", "koap_untraind"], "unknown method 'koap_untraind'; did you mean 'koap_untrained'?"),
        (["--labels", "0"], "--labels must be from 1 to the 100 demonstrations, got 0"),
        (["--labels", "5", "--demonstrations", "3"], "--labels must be from 1 to the 3 demonstrations, got 5"),
        (["--episodes", "0"], "--episodes must be at least 1, got 0"),
        (["--controller-steps", "-1"], "--controller-steps must be at least 0, got -1"),
        (["--blend-decay", "1"], "--blend-decay must be in [0, 1), got 1.0"),
        (["--unlabelled", "foot"], "invalid choice: 'foot'"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is_recorded(benchmark_script, words, said, tmp_path, capsys):
    with pytest.raises(SystemExit):
        benchmark_script("scooping").main(["--folder", str(tmp_path / "none"), *words])
    assert said in capsys.readouterr().err and not (tmp_path / "none").exists()


@pytest.fixture
def study(benchmark_script, monkeypatch, tmp_path):
    """The script with training and rollouts replaced by notes of what was asked for."""
    module, asked = benchmark_script("scooping"), []

    def train(config):
        asked.append(config)
        config.out.mkdir(parents=True)
        summary = {"planner": {"loss_planner": 0.25}, "action_error_mrad": {"controller": 12.34}}
        (config.out / "summary.json").write_text(json.dumps(summary))

    def evaluate(run, config):
        asked.append((run, config))
        rates = {"left": 1.0, "near": 0.5, "right": 0.0}
        rates = {f"success from {name}": {"rate": value} for name, value in rates.items()}
        return {"success_rate": 6 / 15, "rates": rates | {"spoon over the bowl": {"rate": 9 / 15}}}

    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "evaluate", evaluate)
    monkeypatch.setattr(module, "embed_demonstrations", lambda out, *_, **__: (out / "ted").mkdir(parents=True))
    monkeypatch.setattr(module, "load_encoder", lambda projection: None)
    monkeypatch.setattr(module, "TABLE", tmp_path / "scooping.csv")
    for who in ("robot", "hand"):  # recorded before
        (tmp_path / who / "meta").mkdir(parents=True)
        (tmp_path / who / "meta" / "info.json").touch()
    monkeypatch.setattr(module, "record_videos", lambda folder, *_, **__: pytest.fail(f"{folder} is recorded again"))
    module.asked = asked
    return module


def run(study, tmp_path, *words):
    study.main(["--folder", str(tmp_path), "--labels", "5", "--methods", "koap", *words])
    with study.TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_cell_is_trained_rolled_out_and_written_once(study, tmp_path):
    (row,) = run(study, tmp_path, "--unlabelled", "both")
    assert (row["n"], row["successes"], row["rims"]) == ("15", "6", "9")
    assert (row["left"], row["near"], row["right"]) == ("1.000", "0.500", "0.000")
    assert (row["action_error_mrad"], row["planner_error"]) == ("12.3", "0.2500")
    assert float(row["success_low"]) < 0.4 < float(row["success_high"])
    planner, cell, (rolled, how) = study.asked
    assert planner.method == "linear" and cell.planner_from == planner.out and rolled == cell.out
    assert cell.label_episodes == (0, 1, 2, 3, 4) and (how.execution.strategy, how.execution.blend) == (
        "open_loop",
        0.0,
    )
    assert run(study, tmp_path, "--unlabelled", "both") == [row] and len(study.asked) == 3  # it is there already
    again = run(study, tmp_path, "--unlabelled", "both", "--execution", "feedback", "--blend-decay", "0.8")
    assert [(r["execution"], r["blend_decay"]) for r in again] == [("open_loop", "0.0"), ("feedback", "0.8")]
    assert len(study.asked) == 4 and study.asked[3][1].execution.blend == 0.8  # nothing is trained anew


def test_where_every_robot_demonstration_is_labelled_there_is_no_action_error(study, tmp_path, monkeypatch):
    trained = study.train

    def without_errors(config):
        trained(config)
        note = {"planner": {"loss_planner": 0.25}, "action_error_mrad": {"note": "nothing to measure on"}}
        (config.out / "summary.json").write_text(json.dumps(note))

    monkeypatch.setattr(study, "train", without_errors)
    (row,) = run(study, tmp_path, "--unlabelled", "both")
    assert (row["successes"], row["action_error_mrad"]) == ("6", "")


def test_hand_alone_has_a_planner_per_number_of_labels_and_no_analysis(study, tmp_path):
    run(study, tmp_path, "--unlabelled", "hand", "both", "--labels", "5", "2")
    names = [config.out.name for config in study.asked if not isinstance(config, tuple)]
    assert [name for name in names if name.startswith("planner")] == [
        "planner_hand_5_0",
        "planner_hand_2_0",
        "planner_both_0",
    ]
    assert {config.out.name: config.analysis for config in study.asked if not isinstance(config, tuple)}[
        "koap_hand_5_0"
    ] is False


@pytest.mark.parametrize(
    ("unlabelled", "whose"),
    [
        ("both", [("robot", None), ("hand", None)]),
        ("robot", [("robot", None)]),
        ("hand", [("robot", 2), ("hand", None)]),
        ("none", [("robot", 2)]),
    ],
)
def test_a_data_set_holds_the_demonstrations_it_is_called_after(study, monkeypatch, tmp_path, unlabelled, whose):
    asked = []
    monkeypatch.setattr(
        study, "embed_demonstrations", lambda out, sources, encoder, **how: asked.append((sources, how))
    )
    study.data_set(tmp_path, unlabelled, 2)
    ((sources, how),) = asked
    assert [(source.folder.name, source.episodes) for source in sources] == whose
    assert how == {"mixed": len(whose) > 1, "task": "scooping"}


def test_cells_pool_seeds_and_take_the_longest_row_of_each(benchmark_script):
    base = {"labels": "5", "unlabelled": "both", "method": "koap", "execution": "open_loop", "blend_decay": "0.0"}
    rates = {"left": "0.5", "near": "1.0", "right": "0.0", "action_error_mrad": "100.0"}
    rows = [
        base | rates | {"seed": seed, "n": n, "successes": successes, "rims": n}
        for seed, n, successes in (("0", "15", "15"), ("0", "60", "30"), ("1", "60", "42"))
    ]
    rows.append(rows[0] | {"method": "dd", "action_error_mrad": ""})
    cell, other = benchmark_script("scooping_rows").scooping_cells(rows)
    assert (cell["n"], cell["successes"], cell["seeds"]) == (120, 72, ["0", "1"])
    assert cell["left"] == pytest.approx(0.5) and cell["action_error_mrad"] == [100.0, 100.0]
    assert other["method"] == "dd" and other["action_error_mrad"] == []
