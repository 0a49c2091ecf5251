# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the repository's trained policies: lookup by name, compact files, evaluation in the user's folder."""

import json

import pytest
import torch
from publish_pretrained import disturbance_of, publish
from tiny_runs import koap

from torchrl_koap.commands import run_commands
from torchrl_koap.runs import run_directory
from torchrl_koap.runs.run_directory import RunDirectoryError, copy_run, find_run
from torchrl_koap.runs.weights import CheckpointError, load_tensors
from torchrl_koap.training import Trained


@pytest.fixture
def policies(trained_run, tmp_path, monkeypatch):
    """A present folder with the trained policies ``avoiding`` and ``aligning``; both are the tiny run."""
    for name in ("avoiding", "aligning"):
        publish(trained_run, tmp_path / "pretrained" / name, f"# {name}\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "pretrained"


def test_names(policies):
    assert find_run("runs/mine") == run_directory.Path("runs/mine")
    assert find_run("pretrained:avoiding").resolve() == policies / "avoiding"
    with pytest.raises(ValueError, match="unknown pretrained policy 'algning'; did you mean 'aligning'"):
        find_run("pretrained:algning")


def test_an_installed_wheel_has_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_directory, "__file__", str(tmp_path / "site-packages/torchrl_koap/runs/x.py"))
    with pytest.raises(RunDirectoryError, match="no folder 'pretrained' here or beside the package"):
        find_run("pretrained:aligning")


def test_a_published_policy_is_small_and_plans_the_same(trained_run, policies):
    tensors, about = load_tensors(policies / "avoiding" / "controller.safetensors")
    assert about["task"] == "avoiding"
    assert not any(
        tensor.dtype == torch.int8 for tensor in tensors.values()
    )  # frequencies are as the decoder knows them
    small, whole = ((folder / "planner.safetensors").stat().st_size for folder in (policies / "avoiding", trained_run))
    assert small < 0.6 * whole
    planner, exact = Trained.load(policies / "avoiding").planner, Trained.load(trained_run).planner
    history, noise = torch.rand(20, 2, 2), torch.randn(20, 14, 2)
    with torch.no_grad():
        gap = (planner.sample(history, noise) - exact.sample(history, noise)).abs().mean()
        spread = exact.sample(history, noise).std(0).mean()
    assert 0 < gap < 0.05 * spread
    assert next(planner.denoiser.parameters()).dtype == torch.float32
    assert not (policies / "avoiding" / "checkpoints").exists()


def test_a_planner_is_taken_over_by_name(trained_run, policies):
    known = ("--task", "avoiding", "--dataset", json.loads((trained_run / "config.json").read_text())["dataset"])
    few = ("--labels.count", "1", "--controller.steps", "2", "--quiet", "--threads", "1")
    assert koap("train", "--out", "mine", *known, "--planner.source", "pretrained:avoiding", *few) == 0
    mine, published = (Trained.load(folder).planner.state_dict() for folder in ("mine", policies / "avoiding"))
    assert all(torch.equal(mine[name], value) for name, value in published.items())


def test_places_are_left_out_and_what_is_left_is_sealed(trained_run, demonstrations, tmp_path):
    folder = publish(trained_run, tmp_path / "mine", "# mine\n")
    config = json.loads((folder / "config.json").read_text())
    assert (config["out"], config["dataset"]) == (trained_run.name, demonstrations.name)
    assert Trained.load(folder).folder == folder
    (folder / "config.json").write_text(json.dumps(config | {"planner": config["planner"] | {"width": 16}}))
    with pytest.raises(CheckpointError, match="planner.safetensors was trained on planner.width 8, not on 16"):
        Trained.load(folder)
    assert Trained.load(publish(trained_run, folder, "# again\n")).folder == folder  # over another policy of that name


def test_evaluation_in_a_folder_of_ones_own(policies, tmp_path, capfd):
    out = tmp_path / "mine"
    rolled = ("--episodes", "1", "--threads", "1", "--no-animate")
    assert koap("eval", "pretrained:avoiding", "--out", out, *rolled, "--temperature", "0.5") == 0
    result = json.loads((out / "eval.json").read_text())
    assert result["episodes"] == 1 and result["execution"]["temperature"] == 0.5
    assert (out / "index.html").exists() and not (policies / "avoiding" / "eval.json").exists()
    assert koap("eval", "pretrained:avoiding", "--out", out, *rolled, "--no-report") == 0  # again, into the same folder


def test_nothing_is_written_beside_them(policies, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(run_commands, "export_policy", lambda what, file, kind: file.write_bytes(b"a policy"))
    assert koap("export", "pretrained:avoiding", "--out", tmp_path / "exported") == 0
    assert {file.name for file in (tmp_path / "exported").iterdir()} == {"policy.pt2", "policy.json"}
    assert koap("latency", "pretrained:avoiding", "--steps", "2") == 0
    assert not {"inspect.json", "exported", "plots"} & {path.name for path in (policies / "avoiding").iterdir()}
    capfd.readouterr()
    for command in ("eval", "inspect", "export"):
        assert koap(command, "pretrained:avoiding") == 1
        assert "nothing is written into pretrained:avoiding: choose another folder" in capfd.readouterr().err


def test_another_run_is_not_overwritten(trained_run, tmp_path):
    copy_run(trained_run, tmp_path / "mine")
    assert copy_run(tmp_path / "mine", tmp_path / "mine") == tmp_path / "mine", "`--out` may name the run itself"
    assert (tmp_path / "mine" / "demonstrations.safetensors").is_file()  # the report draws them
    config = json.loads((trained_run / "config.json").read_text())
    (tmp_path / "mine" / "config.json").write_text(json.dumps(config | {"run": config["run"] | {"seed": 9}}))
    with pytest.raises(RunDirectoryError, match="holds another run than"):
        copy_run(trained_run, tmp_path / "mine")
    assert json.loads((tmp_path / "mine" / "config.json").read_text())["run"]["seed"] == 9


def test_objects_that_are_not_paths_raise_errors():
    with pytest.raises(TypeError, match=r"must be named by its folder, got dict: train\(TrainConfig"):
        find_run({})


def test_a_card_tells_the_share_of_disturbed_demonstrations(tmp_path):
    for task, share in (("aligning", 0.5), ("avoiding", 0.0)):
        assert koap("demos", "--task", task, "--episodes", 2, "--out", tmp_path / task) == 0
        assert disturbance_of(tmp_path / task) == share
