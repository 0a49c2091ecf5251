# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the study of Scooping: options, rows and cells, with known answers."""

import re

import pytest
from tiny_runs import read_csv


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"methods": ("koap_untraind",)}, "unknown method 'koap_untraind'; did you mean 'koap_untrained'?"),
        ({"labels": (0,)}, "labels must be from 1 to the 100 demonstrations, got 0"),
        ({"labels": (5,), "demonstrations": 3}, "labels must be from 1 to the 3 demonstrations, got 5"),
    ],
)
def test_wrong_options_raise_errors_before_anything_is_recorded(benchmark_script, asked, said, tmp_path):
    with pytest.raises(ValueError, match=re.escape(said)):
        benchmark_script("scooping").main(folder=tmp_path / "none", **asked)
    assert not (tmp_path / "none").exists()


@pytest.fixture
def study(benchmark_script, monkeypatch, tmp_path):
    """The script with training and rollouts replaced by notes of what was asked for."""
    module, asked = benchmark_script("scooping"), []

    def train(config, *, planner_only=False):
        asked.append(config)
        config.out.mkdir(parents=True)
        if planner_only:
            (config.out / "planner.safetensors").touch()
        else:
            (config.out / "summary.json").touch()

    def evaluate(run, config):
        asked.append((run, config))
        starts = {f"success from {start}": {"rate": rate} for start, rate in (("left", 1), ("near", 0.5), ("right", 0))}
        errors = {"outside_budget": {"unit": [{"controller": 0.01234}]}}
        found = {"action_errors_on": "outside_budget", "action_errors": errors}
        return found | {"rates": {"success": {"rate": 6 / 15}, "spoon over the bowl": {"rate": 9 / 15}} | starts}

    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "evaluate", evaluate)
    monkeypatch.setattr(module, "read_recordings", lambda folder, episodes=(), **_: (folder.name, len(episodes)))
    monkeypatch.setattr(module, "join_recordings", list)
    monkeypatch.setattr(module, "embed_recordings", lambda parts, task, out, **_: (out / "ted").mkdir(parents=True))
    for who in ("robot", "hand"):  # recorded before
        (tmp_path / who / "meta").mkdir(parents=True)
        (tmp_path / who / "meta" / "info.json").touch()
    monkeypatch.setattr(module, "record_videos", lambda folder, *_, **__: pytest.fail(f"{folder} is recorded again"))
    module.asked = asked
    return module


def run(study, tmp_path, **options):
    study.main(**{"folder": tmp_path, "labels": (5,), "methods": ("koap",), "results": tmp_path} | options)
    return read_csv(tmp_path / "scooping.csv")


def test_a_cell_is_trained_rolled_out_and_written_once(study, tmp_path):
    (row,) = run(study, tmp_path, unlabelled=("both",))
    assert (row["n"], row["successes"], row["rims"]) == ("15", "6", "9")
    assert (row["left"], row["near"], row["right"]) == ("1.000", "0.500", "0.000")
    assert row["action_error_mrad"] == "12.3"
    planner, cell, (rolled, how) = study.asked
    assert planner.planner.steps == 2000 and cell.planner.source == planner.out and rolled == cell.out
    assert cell.labels.episodes == (0, 1, 2, 3, 4) and (how.execution.replan_interval, how.episodes) == (8, 15)
    assert run(study, tmp_path, unlabelled=("both",)) == [row] and len(study.asked) == 3  # it is there already


def test_hand_alone_has_a_planner_per_number_of_labels_and_dp_none(study, tmp_path):
    run(study, tmp_path, unlabelled=("hand", "both"), labels=(5, 2), methods=("koap", "dp"))
    configs = [config for config in study.asked if not isinstance(config, tuple)]
    planners = [config.out.name for config in configs if config.out.name.startswith("planner")]
    assert planners == ["planner_hand_5_0", "planner_hand_2_0", "planner_both_0"]
    assert all(config.planner.source is None for config in configs if config.method == "dp")


@pytest.mark.parametrize(
    ("unlabelled", "whose"),
    [
        ("both", [("robot", 0), ("hand", 0)]),  # all
        ("robot", [("robot", 0)]),
        ("hand", [("robot", 2), ("hand", 0)]),
        ("none", [("robot", 2)]),
    ],
)
def test_a_data_set_holds_the_demonstrations_of_its_name(study, monkeypatch, tmp_path, unlabelled, whose):
    asked = []
    monkeypatch.setattr(study, "embed_recordings", lambda *given, **how: asked.append((given, how)))
    study.data_set(tmp_path, unlabelled, 2)
    (((parts, task, out), how),) = asked
    assert parts == whose and task.name == "scooping" and out.parent == tmp_path
    assert how["projection"].dim == 96
