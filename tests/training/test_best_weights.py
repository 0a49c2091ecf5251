# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that weights with the best held-out score are kept, and that training then ends."""

from types import SimpleNamespace
from unittest import mock

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_koap.modules import MLPDenoiser, StatePlanner
from torchrl_koap.objectives import PlannerLoss
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.training import best_weights, loop
from torchrl_koap.training.best_weights import BestWeights
from torchrl_koap.training.loop import train_phase


def sample():
    return TensorDict({"state": torch.randn(4, 8, 2).cumsum(1)}, [4])


def training(path, score, *, stop=None, num_steps=100, **options):
    """A small planner, checked every 10 updates; killed after ``stop`` updates."""
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=6, width=8), state_dim=2, horizon=6)
    planner.fit_normalizers(torch.randn(64, 8, 2).cumsum(1))
    loss = PlannerLoss(planner)
    average, best = SoftUpdate(loss, eps=0.9), BestWeights(loss, score, every=10)

    def progress(done, values):
        if done == stop:
            raise KeyboardInterrupt

    run = RunDirectory(path)
    options = {"num_steps": num_steps, "learning_rate": 1e-2, "progress": progress, **options}
    with mock.patch.object(loop, "CHECKPOINT_EVERY", 15):
        train_phase("planner", loss, sample, target_update=average, best=best, run=run, **options)
    return loss, best, run


class Curve:
    """Scores that are known beforehand; remembers the weights that it was shown."""

    def __init__(self, *scores):
        self.scores, self.seen = list(scores), []

    def __call__(self, network):
        self.seen.append({name: value.clone() for name, value in network.state_dict().items()})
        return self.scores[len(self.seen) - 1]


def test_the_latest_good_averaged_weights_are_kept_and_training_ends(tmp_path):
    curve = Curve(0.9, 0.5, 0.52, *[0.53] * 7)
    loss, best, run = training(tmp_path, curve)
    assert (best.best.item(), best.step.item()) == (0.5, 30)
    scores = [float(row["held_out_score"]) for row in run.read_metrics() if row["held_out_score"]]
    assert scores == [0.9, 0.5, 0.52, *[0.53] * 5], "1.5 times 30 updates and four more scores"
    last = run.last_metrics("planner")
    assert last["updates"] == 85, "a resumed run reads from here how many there were"
    assert (last["kept_update"], last["best_held_out_score"]) == (30, 0.5), "also behind the last score"
    assert load_tensors(tmp_path / "checkpoints" / "planner.safetensors")[1]["step"] == 85
    kept = best.network.state_dict()
    assert all(torch.equal(value, kept[name]) for name, value in curve.seen[2].items())
    average = loss.target_network_params.flatten_keys(".")
    assert not torch.equal(average["denoiser.last.weight"], kept["denoiser.last.weight"])


def test_a_score_that_still_falls_ends_nothing(tmp_path):
    _, best, run = training(tmp_path, Curve(*torch.linspace(1, 0.1, 10).tolist()))
    assert best.step.item() == 100 and run.read_metrics()[-1]["step"] == "100"


def test_without_a_score_the_last_weights_are_kept(tmp_path):
    """Where nothing moves on the held-out trajectories there is none: weights of before the training must not stay."""
    curve = Curve(*[float("nan")] * 10)
    loss, best, _ = training(tmp_path, curve)
    assert len(curve.seen) == 10 and best.step.item() == 100
    average, kept = loss.target_network_params.flatten_keys("."), best.network.state_dict()
    assert average.keys() == kept.keys() == curve.seen[-1].keys()
    for name, value in curve.seen[-1].items():
        assert torch.equal(value, kept[name]) and torch.equal(value, average[name]), name


def test_a_missing_score_replaces_no_score(tmp_path):
    _, best, _ = training(tmp_path, Curve(0.5, *[float("nan")] * 9))
    assert (best.best.item(), best.step.item()) == (0.5, 10)


@pytest.mark.parametrize("stop", [16, 33, 61])
def test_a_resumed_training_keeps_the_same_weights_bit_for_bit(tmp_path, stop):
    def score(network):  # of the weights alone
        clock.now += 1
        return (network.denoiser.last.weight.abs().mean() - 0.12).abs().item()

    clock = SimpleNamespace(now=0.0)
    with mock.patch.object(best_weights, "perf_counter", lambda: clock.now):  # every score takes a second
        _, whole, _ = training(tmp_path / "whole", score)
        assert whole.seconds.item() == clock.now
        with pytest.raises(KeyboardInterrupt):
            training(tmp_path / "cut", score, stop=stop)
        _, cut, _ = training(tmp_path / "cut", score, resume=True)
    assert cut.state_dict().keys() == whole.state_dict().keys()
    assert all(torch.equal(value, cut.state_dict()[name]) for name, value in whole.state_dict().items())
    last = [RunDirectory(tmp_path / name).last_metrics("planner") for name in ("whole", "cut")]
    assert last[0]["kept_update"] == whole.step.item() == last[1]["kept_update"]
