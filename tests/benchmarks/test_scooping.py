# This source code is licensed under the MIT license found in the LICENSE file.
"""The study of Scooping: options, rows, tables, probe, outlines and cost, with planted answers."""

from __future__ import annotations

import csv
import json
import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch


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
        starts = {"success_left": 1.0, "success_near": 0.5, "success_right": 0.0}
        return {"success_rate": 6 / 15, "rim_rate": 9 / 15, **starts}

    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "evaluate", evaluate)
    monkeypatch.setattr(module, "embed_demonstrations", lambda out, *_, **__: (out / "ted").mkdir(parents=True))
    monkeypatch.setattr(module, "load_encoder", lambda projection, cache: None)
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
    assert cell.label_episodes == (0, 1, 2, 3, 4) and (how.execution, how.blend_decay) == ("open_loop", 0.0)
    assert run(study, tmp_path, "--unlabelled", "both") == [row] and len(study.asked) == 3  # it is there already
    again = run(study, tmp_path, "--unlabelled", "both", "--execution", "feedback", "--blend-decay", "0.8")
    assert [(r["execution"], r["blend_decay"]) for r in again] == [("open_loop", "0.0"), ("feedback", "0.8")]
    assert len(study.asked) == 4 and study.asked[3][1].blend_decay == 0.8  # nothing is trained anew


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
    ("unlabelled", "whose", "align_to"),
    [
        ("both", [("robot", None), ("hand", None)], None),
        ("robot", [("robot", None)], None),
        ("hand", [("robot", 2), ("hand", None)], None),
        ("hand_aligned", [("robot", 2), ("hand", None)], "robot"),
        ("none", [("robot", 2)], None),
    ],
)
def test_a_data_set_holds_whose_demonstrations_it_is_called_after(
    benchmark_script, study, monkeypatch, tmp_path, unlabelled, whose, align_to
):
    asked = []
    monkeypatch.setattr(
        study, "embed_demonstrations", lambda out, sources, encoder, **how: asked.append((sources, how))
    )
    out = study.data_set(tmp_path, unlabelled, 2)
    ((sources, how),) = asked
    assert [(source.folder.name, source.episodes) for source in sources] == whose
    assert how == {"mixed": len(whose) > 1, "align_to": align_to, "task": "scooping"}
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text(json.dumps({"dataset": str(out)}))
    assert benchmark_script("scooping_parts").whose_demonstrations(tmp_path / "run") == unlabelled


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


def test_a_place_that_the_embedding_holds_is_found_and_one_it_does_not_is_missed(benchmark_script):
    probe_error = benchmark_script("scooping_probe").probe_error
    generator = torch.Generator().manual_seed(0)
    seen = [torch.randn(40, 6, generator=generator) for _ in range(8)]
    mixing = torch.randn(6, 3, generator=generator).double()
    assert probe_error(seen, [part.double() @ mixing + 0.4 for part in seen], 6) < 0.1  # mm
    spoons = [torch.randn(40, 3, generator=generator).double() / 100 for _ in seen]
    assert probe_error(seen, spoons, 6) > 10
    # judged on those held out alone: what the others are like does not matter
    broken = [part if index < 6 else part + 1 for index, part in enumerate(spoons)]
    assert probe_error(seen, broken, 6) > 1000


def test_rows_of_other_probes_stay(benchmark_script, tmp_path):
    probe, table = benchmark_script("scooping_probe"), tmp_path / "probe.csv"
    row = {"pixels": 96, "pooling": "grid", "columns": 96, "embodiment": "hand", "error_mm": "12.0"}
    probe.write(table, [row, row | {"pixels": 128}])
    probe.write(table, [row | {"error_mm": "11.0"}])
    with table.open(newline="") as file:
        assert [(r["pixels"], r["error_mm"]) for r in csv.DictReader(file)] == [("128", "12.0"), ("96", "11.0")]


def test_outlines_overlap_by_hand(benchmark_script):
    overlap = benchmark_script("scooping_silhouette").overlap
    one, other = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert overlap(one, other) == 1.0
    one[0], other[0, :2], other[1, :2] = True, True, True
    assert overlap(one, other) == pytest.approx(2 / 6)


def test_wall_time_is_read_off_the_files(benchmark_script, tmp_path):
    cost = benchmark_script("scooping_cost")

    def write(path, at, text="{}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        os.utime(path, (at, at))

    for who, pace in (("robot", 2), ("hand", 1)):
        for number in range(5):
            write(tmp_path / who / "data" / "chunk-000" / f"episode_{number}.parquet", 1000 + pace * number)
    for number in range(3):
        write(tmp_path / "cache" / f"{number}.safetensors", 2000 + 10 * number)
    write(tmp_path / "planner_both_0" / "summary.json", 0, json.dumps({"train_seconds": {"planner": 7.0}}))
    write(tmp_path / "cell" / "summary.json", 0, json.dumps({"train_seconds": {"planner": 0.1, "controller": 3.0}}))
    write(tmp_path / "cell" / "digests.json", 3000)
    write(tmp_path / "cell" / "eval.json", 3060, json.dumps({"episodes": 15}))
    rows = cost.cost_rows(tmp_path, "cell", "planner_both_0")
    assert [row["seconds"] for row in rows] == ["10", "5", "30", "7", "3", "60"]
    with pytest.raises(ValueError, match="at least two files, got 1"):
        cost.span([tmp_path / "cell" / "eval.json"])


class Reads:
    """A controller whose action is what the embedding's first seven columns hold ``shift`` frames later."""

    in_keys, out_keys, num_past, num_window_frames = ("state",), ("action",), 2, 9

    def __init__(self, change=lambda actions: actions):
        self.change = change

    def __call__(self, data):
        return data.set("action", self.change(data["state"][..., :7]))


@pytest.fixture(scope="module")
def played(benchmark_script):
    """Joint targets that take a piece out of pieces that lie as the parts' experiments have them, and the start."""
    parts = benchmark_script("scooping_parts")
    start, sims, rows = np.array([0.33, 0.0]), parts.ScoopingSimulations("robot", 1), np.zeros(1, dtype=np.int64)
    context = np.array([[*start, parts.TURN]])
    sims.reset(rows, parts.start_joints(context, "robot")[None], [parts.TURN])
    expert, targets = parts.ScoopingExpert(sims, 0, 1, 0), []
    while not sims.success[0] and len(targets) < parts.MOST_STEPS:
        targets.append(expert.target())
        sims.advance(rows, targets[-1][None])
    return parts, sims, start, np.stack(targets)


def test_targets_that_take_a_piece_do_and_those_that_stay_do_not(played):
    parts, sims, start, targets = played
    assert parts.play(sims, start, parts.TURN, targets)
    assert not parts.play(sims, start, parts.TURN, targets[:1].repeat(40, 0))


def test_a_controller_alone_is_judged_by_what_it_decodes(played):
    parts, sims, start, targets = played
    state = torch.zeros(len(targets), parts.EMBEDDING_DIM + 3)
    state[:, :7] = torch.from_numpy(targets)
    state[:, parts.EMBEDDING_DIM : parts.EMBEDDING_DIM + 2] = torch.from_numpy(start)
    assert parts.decoded(sims, SimpleNamespace(controller=Reads()), [state]) == 1
    still = Reads(lambda actions: actions[:, :1].expand_as(actions))
    assert parts.decoded(sims, SimpleNamespace(controller=still), [state]) == 0


def test_experts_that_do_nothing_take_nothing(played, monkeypatch):
    parts, sims, *_ = played

    class Idle:
        finished = False

        def __init__(self, sims, row, start, seed):
            self.hold, self.left = sims.commands[row].copy(), 5

        def target(self):
            self.left -= 1
            self.finished = self.left < 0
            return self.hold

    monkeypatch.setattr(parts, "ScoopingExpert", Idle)
    assert parts.experts(sims, 3) == (0, 0)


@pytest.mark.parametrize(
    ("steps", "lifted"),
    [
        ([-0.01] * 20 + [0.01] * 80, 2),  # into the bowl and out
        ([-0.01] * 18 + [0.0] * 80, 0),  # in, and there it stays
        ([0.01] * 98, 0),  # was never in
    ],
)
def test_an_imagined_spoon_must_go_in_before_it_comes_out(played, steps, lifted):
    parts = played[0]
    generator = torch.Generator().manual_seed(0)
    states = [torch.zeros(30, parts.EMBEDDING_DIM + 3) for _ in range(2)]
    for state in states:  # the first column holds the height, in decimetres
        height = torch.rand(30, generator=generator) * 0.3
        height[0] = 0.2
        state[:, 0], state[:, -1] = 10 * height, height

    class Scripted:
        history, made = 2, 0

        def plan(self, history, generator=None):
            ahead = torch.tensor(steps + [0.0] * 60)[self.made : self.made + 14].cumsum(0)
            self.made += 8
            plan = history[:, -1:].expand(-1, 14, -1).clone()
            plan[..., 0] += 10 * ahead
            return plan

    assert parts.imagined(SimpleNamespace(planner=Scripted()), states, 8) == lifted


def test_the_alignment_of_a_hand_is_measured_in_mm_and_written_once(benchmark_script, monkeypatch, tmp_path):
    script = benchmark_script("scooping_alignment")
    generator, width = torch.Generator().manual_seed(0), script.EMBEDDING_DIM
    look = torch.randn(3, width, generator=generator)

    def parts(shift):
        starts = torch.tensor([[0.5, 0.2, 0.2], [0.3, 0.0, 0.2], [0.5, -0.2, 0.2]])
        share = torch.linspace(0, 1, 30)[:, None]
        places = [starts[number % 3] * (1 - share) + 0.01 * number * share**2 for number in range(12)]
        return [torch.cat([place @ look + shift, place], 1) for place in places]

    steps = parts(0.0) + parts(5.0)
    numbers = torch.cat([torch.full((len(part),), number) for number, part in enumerate(steps)])
    data = {"observation": torch.cat(steps), "episode": numbers}
    monkeypatch.setattr(script, "load_ted", lambda folder: data)
    table = tmp_path / "table.csv"
    words = ["scooping_alignment.py", "--folder", str(tmp_path), "--robots", "3", "--table", str(table)]
    monkeypatch.setattr(sys, "argv", words)
    script.main()
    script.main()
    with table.open(newline="") as file:
        rows = {row["moved"]: row for row in csv.DictReader(file)}
    assert len(rows) == 3 and rows["aligned"]["same_start"] == "12"
    assert float(rows["aligned"]["error_mm"]) < 0.2 * float(rows["not at all"]["error_mm"])
    assert float(rows["by the means"]["error_mm"]) < 0.2 * float(rows["not at all"]["error_mm"])
