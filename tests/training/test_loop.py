# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the training loop: updates, logging, exact resuming, and gradients that are outliers."""

import math
from unittest import mock

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import SoftUpdate

from torchrl_koap.modules import MLPDenoiser, StatePlanner, make_koopman_inverse_dynamics
from torchrl_koap.objectives import KOAPLoss, PlannerLoss
from torchrl_koap.runs.config import PlannerConfig
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import CheckpointError, load_tensors, save_tensors
from torchrl_koap.training import loop
from torchrl_koap.training.checkpoints import load_training_state, save_training_state
from torchrl_koap.training.loop import (
    WARMUP,
    DivergedError,
    Phases,
    moving_average,
    train_phase,
    warmup_cosine,
)


class Interrupt(KeyboardInterrupt):
    pass


def interrupt_at(step):
    def progress(done, values):
        if done == step:
            raise Interrupt

    return progress


class Quadratic(nn.Module):
    """Two losses and a diagnostic that is not to be minimised."""

    def __init__(self, value=3.0):
        super().__init__()
        self.x = nn.Parameter(torch.tensor([value], dtype=torch.float64))

    def forward(self, td):
        x = self.x * td["gain"]
        return TensorDict({"loss_a": x.sum(), "loss_b": 2 * x.sum(), "diagnostic": -1e6 * self.x.sum()})


def constant(gain=1.0):
    return lambda: TensorDict({"gain": torch.tensor([gain], dtype=torch.float64)}, [1])


def test_shape_of_the_learning_rate():
    rates = [warmup_cosine(step, 200, 20) for step in range(200)]
    assert rates[0] == pytest.approx(1 / 20) and max(rates) == rates[19]
    assert rates[100] == pytest.approx(0.5)
    assert rates[150] == pytest.approx(0.5 * (1 + math.cos(0.75 * math.pi)))
    assert all(later < earlier for earlier, later in zip(rates[19:], rates[20:], strict=False))
    assert 0 < rates[-1] < 1e-3
    assert warmup_cosine(0, 10, 0) == 1.0


def test_first_update_is_that_of_adamw_on_the_sum_of_the_losses():
    """After one step Adam's moments cancel: x - lr wd x - lr sign(gradient), with lr after one step of warm-up."""
    loss = Quadratic()
    values = train_phase("x", loss, constant(), num_steps=1, learning_rate=0.4, weight_decay=0.1)
    rate = 0.4 / WARMUP
    assert loss.x.item() == pytest.approx(3 - rate * 0.1 * 3 - rate, abs=1e-6)
    assert values["loss_a"] == 3 and values["loss_b"] == 6 and values["learning_rate"] == pytest.approx(rate)
    assert "diagnostic" not in values and values["iterations_per_second"] > 0


def test_a_denoiser_is_trained_at_its_own_rate_with_weight_decay(monkeypatch):
    """Without a gradient only the decay is left."""
    monkeypatch.setattr(loop, "moving_average", lambda *_: None)
    loss, phases = Quadratic(), Phases()
    values = phases.denoise("x", loss, constant(0.0), PlannerConfig(steps=1, learning_rate=0.4))
    assert values["learning_rate"] == pytest.approx(0.4 / WARMUP)
    assert 3 - loss.x.item() == pytest.approx(3 * 0.4 / WARMUP * 1e-4)
    phases("y", loss, constant(), num_steps=3, learning_rate=0.1)
    assert phases.updates == 4


def test_logger_and_progress_hear_of_every_logged_step():
    class Logger(list):
        def log_scalar(self, name, value, step):
            self.append((name, value, step))

    logger, seen = Logger(), []
    train_phase(
        "phase",
        Quadratic(),
        constant(),
        num_steps=7,
        learning_rate=0.0,
        log_every=3,
        logger=logger,
        progress=lambda done, values: seen.append((done, values.get("loss_a"))),
    )
    assert [(n, v, s) for n, v, s in logger if n == "phase/loss_b"] == [
        ("phase/loss_b", 6.0, step) for step in (3, 6, 7)
    ]
    assert {name for name, _, _ in logger} == {
        f"phase/{name}" for name in ("loss_a", "loss_b", "learning_rate", "iterations_per_second")
    }
    assert seen == [(1, None), (2, None), (3, 3.0), (4, 3.0), (5, 3.0), (6, 3.0), (7, 3.0)]


class Planner:
    """Everything of a run with a small planner, its moving average included."""

    phase = "planner"

    def __init__(self, seed=0):
        torch.manual_seed(seed)
        planner = StatePlanner(MLPDenoiser(2, 4, horizon=6, width=16), state_dim=2, horizon=6)
        planner.fit_normalizers(self.windows(64))
        self.loss = PlannerLoss(planner)
        self.average = SoftUpdate(self.loss, eps=0.8)

    @staticmethod
    def windows(number):
        return torch.randn(number, 8, 2).cumsum(1)

    def sample(self):
        return TensorDict({"state": self.windows(4)}, [4])


class Controller(Planner):
    phase = "controller"

    def __init__(self, seed=0):
        torch.manual_seed(seed)
        model = make_koopman_inverse_dynamics(2, 2, preset="paper", latent_dim=8, hidden_dim=8)
        self.loss, self.average = KOAPLoss(model), None

    def sample(self):
        state, labelled = torch.randn(4, 12, 2).cumsum(1), torch.rand(4, 12, 1) < 0.5
        action = torch.where(labelled, torch.randn(4, 12, 2), torch.nan)
        return TensorDict({"state": state, "action": action, "has_action": labelled}, [4])


def run_training(kind, path, **options):
    parts = kind()
    torch.manual_seed(1)
    run = RunDirectory(path)
    options = {"num_steps": 40, "learning_rate": 1e-2, "log_every": 5, **options}
    with mock.patch.object(loop, "CHECKPOINT_EVERY", 10):
        values = train_phase(parts.phase, parts.loss, parts.sample, target_update=parts.average, run=run, **options)
    return parts.loss, run, values


def rows_without_speed(run):
    return [{key: value for key, value in row.items() if key != "iterations_per_second"} for row in run.read_metrics()]


@pytest.fixture(scope="module", params=[Planner, Controller])
def uninterrupted(request, tmp_path_factory):
    return request.param, *run_training(request.param, tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("stops", [[3], [20, 21], [10, 11, 27, 39], [40]], ids=str)
def test_an_interrupted_training_ends_bit_for_bit_like_an_uninterrupted_one(uninterrupted, tmp_path, stops):
    """Killed before the first checkpoint, beside checkpoints, several times, and after the last update."""
    kind, loss, run, values = uninterrupted
    for stop in stops:
        with pytest.raises(Interrupt):
            run_training(kind, tmp_path, resume=True, progress=interrupt_at(stop))
    resumed, resumed_run, resumed_values = run_training(kind, tmp_path, resume=True)
    state = loss.state_dict()
    assert state.keys() == resumed.state_dict().keys()
    assert kind is Controller or any("target" in name for name in state)
    for name, value in resumed.state_dict().items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, state[name], rtol=0, atol=0, equal_nan=True)
    assert rows_without_speed(resumed_run) == rows_without_speed(run)
    assert len(run.read_metrics()) == 8
    assert {**resumed_values, "iterations_per_second": 0} == {**values, "iterations_per_second": 0}
    whole, about = load_tensors(run.path / "checkpoints" / f"{kind.phase}.safetensors")
    again, same = load_tensors(tmp_path / "checkpoints" / f"{kind.phase}.safetensors")
    assert about == same and about["step"] == 40
    assert whole["limit.seen"] == 40 and whole["limit.mean_square"] > 0, "what gradients are compared with goes on too"
    for name, value in whole.items():
        torch.testing.assert_close(again[name], value, rtol=0, atol=0, equal_nan=True)


def test_a_finished_training_is_not_repeated(uninterrupted, tmp_path):
    kind, _, run, values = uninterrupted
    before = {file.name: file.read_bytes() for file in run.path.rglob("*") if file.is_file()}

    def fail(done, values):
        raise AssertionError("no update is left")

    _, _, again = run_training(kind, run.path, resume=True, progress=fail)
    assert {key: again[key] for key in values if "loss" in key} == {k: v for k, v in values.items() if "loss" in k}
    assert {file.name: file.read_bytes() for file in run.path.rglob("*") if file.is_file()} == before


def test_without_resume_the_checkpoint_is_ignored(tmp_path):
    run_training(Planner, tmp_path, num_steps=10)
    seen = []
    run_training(Planner, tmp_path, num_steps=10, progress=lambda done, values: seen.append(done))
    assert seen == list(range(1, 11))


def test_a_checkpoint_of_another_model_is_refused(tmp_path):
    run_training(Planner, tmp_path, num_steps=10)
    (tmp_path / "checkpoints" / "planner.safetensors").rename(tmp_path / "checkpoints" / "controller.safetensors")
    with pytest.raises(CheckpointError, match="controller.safetensors holds the state of another model"):
        run_training(Controller, tmp_path, resume=True)
    weights = nn.Linear(2, 2).state_dict()
    save_tensors(tmp_path / "checkpoints" / "controller.safetensors", weights, {"task": "avoiding"})
    with pytest.raises(CheckpointError, match="is not a training state"):
        run_training(Controller, tmp_path, resume=True)


def test_a_training_on_the_cpu_leaves_gpus_alone(tmp_path, monkeypatch):
    """Reading their random states would reserve memory on each, and another number of GPUs could not restore them."""
    module, path = nn.Linear(2, 2), tmp_path / "state.safetensors"
    optimizer = torch.optim.AdamW(module.parameters())
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    for name in ("get_rng_state", "get_rng_state_all", "set_rng_state_all"):
        monkeypatch.setattr(f"torch.cuda.{name}", lambda *_: pytest.fail("a GPU was asked"))
    save_training_state(path, module, optimizer, {"step": 3})
    assert load_training_state(path, module, optimizer) == {"step": 3}


@pytest.mark.parametrize(
    ("log_every", "message"),
    [(5, "loss_a, loss_b is not finite at step 10"), (500, "parameters are not finite at step 10")],
)
def test_divergence_is_found_and_the_last_good_checkpoint_kept(tmp_path, monkeypatch, log_every, message):
    monkeypatch.setattr(loop, "CHECKPOINT_EVERY", 5)
    calls = []

    def sample():
        calls.append(1)
        return constant(math.nan if len(calls) == 8 else 1.0)()

    with pytest.raises(DivergedError, match=f"phase: {message}; lower the learning rate"):
        train_phase(
            "phase",
            Quadratic(),
            sample,
            num_steps=20,
            learning_rate=0.1,
            log_every=log_every,
            run=RunDirectory(tmp_path),
        )
    tensors, about = load_tensors(tmp_path / "checkpoints" / "phase.safetensors")
    assert about["step"] == 5 and tensors["loss.x"].isfinite().all()


@pytest.mark.parametrize("kind", [Planner, Controller])
def test_ctrl_c_inside_a_loss_raises_keyboard_interrupt(kind):
    parts = kind()
    before = {key: value.clone() for key, value in parts.loss.state_dict().items()}

    def interrupt(*args):
        raise Interrupt

    for inner in parts.loss.network.modules():
        inner.register_forward_pre_hook(interrupt)
    with pytest.raises(Interrupt):
        train_phase("x", parts.loss, parts.sample, num_steps=1, learning_rate=1e-3)
    for key, value in parts.loss.state_dict().items():
        torch.testing.assert_close(value, before[key], equal_nan=True)


def test_an_interrupt_behind_several_errors_is_one():
    parts = Planner()

    def sample():
        try:
            raise Interrupt
        except Interrupt:
            try:
                raise ValueError("met on the way out")
            except ValueError:
                raise RuntimeError("Converting a tensordict to boolean value is not permitted")  # noqa: B904

    with pytest.raises(Interrupt):
        train_phase("x", parts.loss, sample, num_steps=1, learning_rate=1e-3)


@pytest.mark.parametrize("updates, averaged", [(8, [4, 8]), (6, [4, 6]), (1, [1])])
def test_the_average_is_stepped_every_fourth_update_and_at_the_end(updates, averaged):
    class Average:
        def __init__(self):
            self.seen = []

        def step(self):
            self.seen.append(len(drawn))

    drawn, average = [], Average()
    options = {"num_steps": updates, "learning_rate": 0.1, "target_update": average}
    train_phase("x", Quadratic(), lambda: drawn.append(1) or constant()(), **options)
    assert average.seen == averaged


def test_the_average_over_four_updates_has_the_same_decay():
    module = Planner().loss
    assert moving_average(module, 90).eps == pytest.approx(0.9**4)
    assert moving_average(module, 10**6).eps == pytest.approx(0.998**4)
    assert moving_average(module, 2).eps == 0.5


def test_the_logged_speed_is_that_since_the_last_entry(monkeypatch):
    clock = iter((5.0, 10.0))
    monkeypatch.setattr(loop.time, "perf_counter", lambda: next(clock))
    log, terms = loop._Log("planner", None, None, 100, 0.0), TensorDict({"loss_planner": torch.ones([])})
    assert [log(step, terms, 0.1, {})["iterations_per_second"] for step in (150, 160)] == [10.0, 2.0]
