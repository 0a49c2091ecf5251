# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the choice of the next demonstrations to label: against brute force, and without reading labels."""

import json
import re
import shutil

import numpy as np
import pytest
import torch
from command_calls import fails
from tiny_runs import TINY, koap

from torchrl_koap import ControllerConfig, LabelConfig, PlannerConfig, TrainConfig, save_demonstrations, train
from torchrl_koap.data import make_recordings
from torchrl_koap.data.ted import source_names
from torchrl_koap.evaluation import active_labelling
from torchrl_koap.evaluation.active_labelling import SuggestConfig, rank_trajectories, suggest
from torchrl_koap.training import trained

EPISODE = torch.arange(7).repeat_interleave(torch.tensor([5, 3, 6, 4, 5, 2, 5]))
KNOWN = EPISODE == 2


def latents(width=4):
    generator = torch.Generator().manual_seed(3)
    # every trajectory has directions of its own
    sizes = torch.rand(7, width, generator=generator, dtype=torch.float64) ** 2
    return torch.randn(len(EPISODE), width, generator=generator, dtype=torch.float64) * sizes[EPISODE]


def mean_leverage(latent, rows, scale, where=slice(None)):
    precision = latent[rows].T @ latent[rows] + scale * torch.eye(latent.shape[1], dtype=latent.dtype)
    return ((latent @ precision.inverse()) * latent).sum(-1)[where].mean().item()


def uncertainty(latent, covariance, moment):
    """Another score than the default: mean leverage of the trajectory itself."""
    return ((latent @ covariance) * latent).sum(-1).mean().item()


def test_a_optimal_greedy_choice_equals_brute_force():
    latent, penalty = latents(), 0.05
    scale = penalty * latent[KNOWN].square().sum(-1).mean()
    rows, wanted = KNOWN.clone(), []
    for _ in range(4):
        now = mean_leverage(latent, rows, scale)
        gains = {
            name: now - mean_leverage(latent, rows | (name == EPISODE), scale)
            for name in range(7)
            if name not in EPISODE[rows]
        }
        best = max(gains, key=gains.get)
        wanted.append((best, gains[best]))
        rows |= best == EPISODE
    found = rank_trajectories(latent, EPISODE, KNOWN, penalty=penalty, count=4)
    assert [choice.episode for choice in found] == [best for best, _ in wanted]
    assert [choice.score for choice in found] == pytest.approx([gain for _, gain in wanted])


@pytest.mark.parametrize(("bias", "tolerance"), [(False, 1e-9), (True, 2e-3)])
def test_scores_are_the_decoder_s_own_uncertainty(bias, tolerance):
    latent = latents() + (2 if bias else 0)
    mean = latent[KNOWN].mean(0) if bias else torch.zeros(4).double()
    known, offered = latent[KNOWN] - mean, latent - mean
    ridge = 0.05 * known.square().sum(-1).mean() * torch.eye(4).double()
    inverse = torch.linalg.inv(known.mT @ known + ridge)
    relative = torch.einsum("ni,ij,nj->n", offered, inverse, offered) + (1 / len(known) if bias else 0)
    chosen = rank_trajectories(latent, EPISODE, KNOWN, penalty=0.05, score=uncertainty, count=1, bias=bias)[0]
    assert chosen.score == pytest.approx(relative[chosen.episode == EPISODE].mean().item(), rel=tolerance)


def test_only_unlabelled_steps_are_offered_and_counted():
    latent = latents()
    labelled = EPISODE != 0
    labelled[1:5] = True  # of trajectory 0 the first step is left
    chosen = rank_trajectories(latent, EPISODE, labelled, penalty=0.1, score=uncertainty, count=1)[0]
    scale = 0.1 * latent[labelled].square().sum(-1).mean()
    assert chosen.episode == 0
    assert chosen.score == pytest.approx(mean_leverage(latent, labelled, scale, slice(0, 1)))
    with pytest.raises(ValueError, match="count must be in 1..1"):
        rank_trajectories(latent, EPISODE, labelled, penalty=0.1, count=2)


def test_a_first_choice_needs_no_label():
    found = rank_trajectories(latents(), EPISODE, torch.zeros_like(KNOWN), penalty=0.05, count=7)
    assert sorted(choice.episode for choice in found) == list(range(7))
    scores = [choice.score for choice in found]
    assert scores[0] == max(scores) and min(scores) > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count must be in 1..6"),
        ({"count": 7}, "count must be in 1..6, the trajectories that are not labelled yet, got 7"),
        ({"penalty": 0.0}, "penalty must be positive"),
        ({"labelled": torch.ones_like(KNOWN)}, "nothing is left to suggest"),
        ({"labelled": KNOWN.float()}, "labelled must be bool"),
        ({"labelled": KNOWN[:-1]}, "wanted latent"),
        ({"latent": torch.full((30, 4), torch.nan)}, "latent actions must be finite"),
    ],
)
def test_bad_arguments(change, message):
    arguments = {"latent": latents(), "episode": EPISODE, "labelled": KNOWN, "penalty": 0.1} | change
    with pytest.raises(ValueError, match=message):
        rank_trajectories(**arguments)


def test_recordings_without_actions_are_to_get_them_first(tmp_path):
    states = [np.random.default_rng(index).normal(size=(30, 2)).cumsum(0) for index in range(4)]
    actions = [np.diff(states[0], axis=0), None, None, np.diff(states[3], axis=0)]
    data = save_demonstrations(tmp_path / "arm", states, actions, control_hz=30)
    few = {"planner": PlannerConfig(steps=2, width=8), "controller": ControllerConfig(steps=2)}
    train(TrainConfig(dataset=str(data), out=tmp_path / "run", labels=LabelConfig(episodes=(0,)), **few))
    said = suggest(tmp_path / "run", SuggestConfig(count=3))["next"]
    first, _, then = said.partition(", then ")
    assert re.match(r"add actions to recordings (1, 2|2, 1) \(counted from 0; files in the order of their names", first)
    assert first.endswith(" and convert them again (--name arm --out DATA)")
    more = [np.diff(frames, axis=0) for frames in states]
    again = save_demonstrations(tmp_path / "more", states, more, control_hz=30, name="arm")
    words = [str(again) if word == "DATA" else word for word in then.removesuffix(" NEW").split()]
    assert koap(*words[1:], tmp_path / "new", "--quiet") == 0
    planners = [(tmp_path / run / "planner.safetensors").read_bytes() for run in ("run", "new")]
    assert planners[0] == planners[1]  # plans know no labels: it is not trained again


def test_recordings_are_suggested_by_their_files(tmp_path):
    """Gaps and dropped recordings shift numbers of trajectories against those of files."""
    states = [np.random.default_rng(index).normal(size=(30, 2)).cumsum(0) for index in range(3)]
    names = ["a.csv[0]", "a.csv[1]", "c.csv"]
    recordings = make_recordings(states, [np.diff(states[0], axis=0), None, None], control_hz=30, sources=names)
    data = save_demonstrations(tmp_path / "arm", recordings)
    assert source_names(data) == names
    few = {"planner": PlannerConfig(steps=2, width=8), "controller": ControllerConfig(steps=2)}
    train(TrainConfig(dataset=str(data), out=tmp_path / "run", **few))
    found = suggest(tmp_path / "run", SuggestConfig(count=2))
    assert {row["episode"]: row["source"] for row in found["suggestions"]} == {1: "a.csv[1]", 2: "c.csv"}
    assert re.match(r"add actions to recordings (a.csv\[1\], c.csv|c.csv, a.csv\[1\]) and convert", found["next"])


def test_the_next_training_is_as_the_first_one(copied_run, tmp_path):
    config = json.loads((copied_run / "config.json").read_text())
    config["run"]["plugins"] = ["json"]
    config["planner"]["learning_rate"] = 2e-3
    (copied_run / "config.json").write_text(json.dumps(config))
    said = suggest(copied_run, SuggestConfig(count=1, plugins=("csv",)))["next"]
    assert f" --plugin csv --planner.source {copied_run} --labels.episodes " in said
    assert koap(*said.removesuffix(" NEW").split()[1:], tmp_path / "new", "--quiet") == 0
    again = json.loads((tmp_path / "new" / "config.json").read_text())
    assert again["labels"]["episodes"] == list(map(int, said.split("--labels.episodes ")[1].split(" --out")[0].split()))
    assert again["run"]["plugins"] == ["json", "csv"] and again["controller"] == config["controller"]
    assert again["dataset"] == config["dataset"]
    assert again["planner"] == config["planner"] | {"source": str(copied_run.absolute())}


def test_windows_that_had_labels_are_proposed_as_whole_trajectories(demonstrations, tmp_path):
    few = [word.replace("2", "0.2") if TINY[place - 1] == "--labels" else word for place, word in enumerate(TINY)]
    few += ["--labels.unit", "window"]
    assert koap("train", "--out", tmp_path / "run", "--dataset", demonstrations, "--method", "koap", *few) == 0
    found = suggest(tmp_path / "run", SuggestConfig(count=2))
    assert set(found["labelled_episodes"]) & {row["episode"] for row in found["suggestions"]}  # in part labelled
    words = found["next"].removesuffix(" NEW").split()
    assert koap(*words[1:], tmp_path / "new", "--quiet") == 0


def test_labelled_parts_of_a_recording_are_no_labels_of_the_rest(tmp_path):
    states = [np.random.default_rng(index).normal(size=(30, 2)).cumsum(0) for index in range(3)]
    actions = [np.diff(frames, axis=0) for frames in states]
    for steps in actions[:2]:
        steps[10:] = np.nan
    data = save_demonstrations(tmp_path / "arm", states, actions, control_hz=30)
    few = {"planner": PlannerConfig(steps=2, width=8), "controller": ControllerConfig(steps=2)}
    train(TrainConfig(dataset=str(data), out=tmp_path / "run", labels=LabelConfig(episodes=(0,)), **few))
    found = suggest(tmp_path / "run", SuggestConfig(count=3))
    assert {row["episode"] for row in found["suggestions"]} == {0, 1, 2}
    assert found["next"].startswith("add actions to recordings 0 (")  # those of 1 and 2 are hidden, not missing


def test_the_next_training_has_more_labels_than_a_share_of_the_trajectories_allows(demonstrations, tmp_path):
    few = [*TINY, "--labels.trajectories", "0.25"]
    assert koap("train", "--out", tmp_path / "run", "--dataset", demonstrations, *few) == 0
    words = suggest(tmp_path / "run", SuggestConfig(count=2))["next"].removesuffix(" NEW").split()
    assert koap(*words[1:], tmp_path / "new", "--quiet") == 0


def test_nothing_is_written_for_a_pretrained_run(copied_run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(copied_run, tmp_path / "pretrained" / "mine")
    before = sorted(path.name for path in tmp_path.rglob("*"))
    assert koap("suggest", "pretrained:mine", "--count", "1") == 0
    assert "next" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_suggest_from_the_shell(copied_run, capsys):
    assert koap("suggest", copied_run, "--count", "3") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    written = json.loads((copied_run / "suggestions.json").read_text())
    rows = written["suggestions"]
    labels = json.loads((copied_run / "summary.json").read_text())["labels"]
    assert [row["rank"] for row in rows] == [1, 2, 3]
    assert rows[0]["score"] >= rows[1]["score"] >= rows[2]["score"] > 0
    assert written["labelled_steps"] == labels["labelled_transitions"]
    # demonstration i has 30 + i rows and one step less
    assert all(row["steps"] == 29 + row["episode"] for row in rows)
    for line, row in zip(lines, rows, strict=False):
        assert re.fullmatch(rf"episode {row['episode']} +steps {row['steps']}, score [\d.e-]+", line)
    # what to call next keeps the labels that are there
    assert lines[3].split("--labels.episodes ")[1].removesuffix(" --out NEW").split() == [
        str(episode) for episode in [*written["labelled_episodes"], *(row["episode"] for row in rows)]
    ]
    assert len(written["labelled_episodes"]) == labels["trajectories_touched"]
    assert f"koap train --config {copied_run / 'config.json'} --planner.source" in lines[3]
    assert koap("suggest", copied_run, "--count", "7") == 1  # 2 of 8 are labelled
    assert "count must be in 1..6" in capsys.readouterr().err


def test_the_default_count_is_limited_by_the_remaining_trajectories(copied_run, monkeypatch):
    monkeypatch.setattr(active_labelling, "_DEFAULT_COUNT", 10)
    assert len(suggest(copied_run)["suggestions"]) == 6


def test_hidden_labels_do_not_change_the_suggestions(copied_run, monkeypatch):
    load = trained.open_dataset
    first = suggest(copied_run, SuggestConfig(count=6))

    def other_labels(*arguments, **options):
        data, task = load(*arguments, **options)
        seen = torch.isin(data["episode"], torch.tensor(first["labelled_episodes"])).unsqueeze(-1)
        return data.set("action", torch.where(seen, data["action"], torch.randn_like(data["action"]) * 1e3)), task

    monkeypatch.setattr(trained, "open_dataset", other_labels)
    assert suggest(copied_run, SuggestConfig(count=6)) == first
    seen, infer = [], active_labelling.infer_steps
    monkeypatch.setattr(
        active_labelling, "infer_steps", lambda net, data, **options: seen.append(data) or infer(net, data, **options)
    )
    suggest(copied_run, SuggestConfig(count=1))
    assert seen[0]["action"].isnan().all(-1).equal(~seen[0]["has_action"].squeeze(-1))


def test_of_many_steps_some_are_looked_at_and_the_scores_are_as_of_all(copied_run, monkeypatch):
    every = suggest(copied_run, SuggestConfig(count=3))
    monkeypatch.setattr(active_labelling, "_MOST_STEPS", 100)
    some = suggest(copied_run, SuggestConfig(count=3))
    scores = [[row["score"] for row in found["suggestions"]] for found in (every, some)]
    assert scores[0] != scores[1] and scores[0] == pytest.approx(scores[1], rel=0.3)
    assert some["suggestions"][0]["steps"] == every["suggestions"][0]["steps"]


def test_the_choice_is_made_for_the_decoder_of_the_run(demonstrations, copied_run, tmp_path, monkeypatch):
    paper, seen, rank = tmp_path / "paper", {}, active_labelling.rank_trajectories
    assert koap("train", "--out", paper, "--dataset", demonstrations, *TINY, "--preset", "paper") == 0
    monkeypatch.setattr(
        active_labelling, "rank_trajectories", lambda *args, **options: seen.update(options) or rank(*args, **options)
    )
    for out, bias in ((copied_run, False), (paper, True)):
        suggest(out, SuggestConfig(count=1))
        fit = json.loads((out / "summary.json").read_text())["decoder_fit"]
        assert seen["bias"] is bias and seen["penalty"] == fit["penalty"]


def test_runs_without_suggestions_raise_errors(demonstrations, copied_run, tmp_path, capsys):
    linear = ("--out", tmp_path / "linear", "--dataset", demonstrations, *TINY, "--method", "linear")
    assert koap("train", *linear) == 0
    assert "suggestions need latent actions" in fails(capsys, "suggest", tmp_path / "linear")
    summary = json.loads((copied_run / "summary.json").read_text())
    del summary["decoder_fit"]  # as a decoder that was trained by gradients
    (copied_run / "summary.json").write_text(json.dumps(summary))
    assert "train with `--method koap`" in fails(capsys, "suggest", copied_run)
