# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests ``koap eval``: the files that it writes and the effects of its options."""

import json
import re
from dataclasses import replace

import pytest
import torch
from command_calls import contents, fails
from tiny_runs import koap
from torchrl.envs import TransformedEnv

from torchrl_koap.evaluation import EvalConfig, closed_loop, evaluate, latency
from torchrl_koap.evaluation.closed_loop import choose_contexts, find_environment
from torchrl_koap.evaluation.data_errors import AFTER
from torchrl_koap.evaluation.statistics import rate
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import get_task


def test_what_an_evaluation_writes(copied_run, capsys):
    """The contract of eval.json, a report with pictures, and numbers that depend on the seeds alone."""
    assert koap("eval", copied_run, "--episodes", 3, "--seed", 100, "--threads", 1, "--no-animate") == 0
    result = json.loads((copied_run / "eval.json").read_text())
    rows = result["episode"]
    assert [row["seed"] for row in rows] == [100, 101, 102]
    assert {row["outcome"] for row in rows} <= {"success", "collision", "timeout"}
    assert result["rates"]["success"] == rate([row["outcome"] == "success" for row in rows]) and result["episodes"] == 3
    assert result["collisions"] == sum(row["outcome"] == "collision" for row in rows)
    assert result["mean_steps"] == pytest.approx(sum(row["steps"] for row in rows) / 3)
    assert all(-1 <= row["mode"] < 24 for row in rows)
    assert 0 <= result["mode_entropy"] <= 1 if result["rates"]["success"]["rate"] else result["mode_entropy"] is None
    assert result["control_hz"] > 0 and result["plan_ms"] >= 0 and result["control_ms"] > 0
    assert (result["execution"]["strategy"], result["execution"]["replan_interval"]) == ("feedback", 4)
    tensors, about = load_tensors(copied_run / "rollouts.safetensors")
    assert tensors["length"].tolist() == [row["steps"] for row in rows] and about["task"] == "avoiding"
    assert (copied_run / "index.html").stat().st_size > 1000
    out = capsys.readouterr().out
    lines = dict(line.split("  ", 1) for line in out.splitlines() if "  " in line)
    assert re.fullmatch(r" *\d+\.\d %; 95 % interval .* %, \d of 3 rollouts", lines["success"])
    assert "always the mean action" in lines["action error, 2 columns"] and "{" not in out


@pytest.mark.parametrize("command", ["eval", "inspect"])
def test_a_folder_in_which_another_command_works_is_left_alone(command, copied_run, capsys):
    before = contents(copied_run)
    with RunDirectory(copied_run).locked("koap train"):
        line = fails(capsys, command, copied_run, "--episodes", 2)
    assert f"another command is working in {copied_run}: call `koap {command}` again when it has ended" in line
    assert contents(copied_run) == before


def test_labels_outside_the_budget_are_read_here_alone(copied_run, demonstrations, no_report, tmp_path):
    """Counted, decoded by controller and ridge; none where the data are not there."""
    assert not (copied_run / "actions.safetensors").exists()
    call = ("eval", copied_run, "--episodes", 1, "--threads", 1)
    assert koap(*call) == 0
    result = json.loads((copied_run / "eval.json").read_text())
    outside = result["action_errors"]["outside_budget"]
    labels = json.loads((copied_run / "summary.json").read_text())["labels"]
    hidden = labels["total_transitions"] - labels["labelled_transitions"]
    assert result["labels_read_outside_budget"] == outside["labels"] == hidden - 6 * AFTER
    assert outside["trajectories"] == 6 and min(outside["unit"][0][name] for name in ("controller", "ridge")) > 0
    assert len(load_tensors(copied_run / "actions.safetensors")[0]["true"]) == outside["labels"]
    assert koap(*call, "--dataset", tmp_path / "gone") == 1
    config = json.loads((copied_run / "config.json").read_text()) | {"dataset": str(tmp_path / "gone")}
    (copied_run / "config.json").write_text(json.dumps(config))
    assert koap(*call) == 0
    result = json.loads((copied_run / "eval.json").read_text())
    assert result["labels_read_outside_budget"] == 0 and result["relative_action_error"] is None
    assert "is not there" in result["action_errors"]["outside_budget"]["note"]


def test_an_animation_that_cannot_be_made_is_skipped(copied_run, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.warns(UserWarning, match="^film.gif was not made: .*disable"):
        assert koap("eval", copied_run, "--episodes", 1, "--threads", 1, "--quiet") == 0
    assert "film.gif was not made" in (copied_run / "index.html").read_text()
    made = {file.name for file in (copied_run / "plots").iterdir()}
    assert {"rollouts.gif", "rollouts.png"} <= made and "film.gif" not in made
    assert koap("eval", copied_run, "--episodes", 1, "--threads", 1, "--quiet", "--no-report") == 0
    assert not (copied_run / "index.html").exists()  # it told the numbers of the earlier evaluation


def test_rollouts_of_a_context_follow_each_other():
    numbers, places = choose_contexts(get_task("aligning"), EvalConfig(episodes=5, rollouts_per_context=2))
    assert numbers == [0, 0, 1, 1, 2] and (places[0] == places[1]).all() and (places[1] != places[2]).any()


def test_rollouts_begin_in_their_contexts_and_have_the_scores_of_their_task(tmp_path, monkeypatch):
    config = EvalConfig(episodes=4, rollouts_per_context=2, threads=1, batch_size=3, out=tmp_path / "run")
    found, sizes = find_environment(get_task("stacking"), config), []
    found = replace(found, max_steps=2, make_env=lambda n, make=found.make_env: sizes.append(n) or make(n))
    monkeypatch.setattr(closed_loop, "find_environment", lambda *_: found)
    result = evaluate("pretrained:stacking", config)
    assert sizes == [3, 1]
    tensors = load_tensors(tmp_path / "run" / "rollouts.safetensors")[0]
    assert [row["context"] for row in result["episode"]] == [0, 0, 1, 1] and result["contexts"] == 2
    assert list(result["rates"]) == ["success", "one box stacked", "two boxes stacked"]
    assert torch.equal(tensors["context"], torch.from_numpy(found.contexts))
    began, wanted = tensors["object_position"][:, 0], tensors["context"][..., :2]
    assert (began - wanted).abs().max() < 0.01 < (wanted[0] - wanted[2]).abs().max()


@pytest.mark.parametrize(("name", "noisy"), [("avoiding", False), ("po_sorting", True)])
def test_evaluation_uses_the_noise_of_the_task(name, noisy):
    env = find_environment(get_task(name), EvalConfig()).make_env(1)
    assert isinstance(env, TransformedEnv) == noisy


def test_a_step_after_a_late_one_is_not_late(monkeypatch):
    class Clock:
        now = 0.0

        def perf_counter(self):
            return self.now

        def sleep(self, seconds):
            self.now += seconds

    class Slow:
        took = iter((0.01, 0.26, 0.01, 0.01))

        def reset(self):
            pass

        def act(self, observation):
            clock.sleep(next(self.took))

    clock = Clock()
    monkeypatch.setattr(latency, "time", clock)
    found = latency.run_control_loop(Slow(), range(4), control_hz=10.0)
    assert found["late_steps"] == 1 and found["max"] == pytest.approx(260) and found["step_ms"] == 100
