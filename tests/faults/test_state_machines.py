# This source code is licensed under the MIT license found in the LICENSE file.
"""Trainings that are killed, damaged and resumed in any order, and label budgets one after the other."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from tensordict import TensorDict
from torch import nn

from torchrl_koap.data import LabelBudget, flatten_trajectories
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import CheckpointError
from torchrl_koap.training.loop import train_phase

STEPS = 24


class Killed(BaseException):
    """The process is gone, at whatever update."""


class Loss(nn.Module):
    """A small regression with noise of its own, so that the random state matters."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layer = nn.Linear(3, 2)

    def forward(self, batch):
        noise = 0.1 * torch.randn_like(batch["x"])
        return TensorDict({"loss_fit": (self.layer(batch["x"] + noise) - batch["x"][:, :2]).square().mean()})


def train(folder: Path, *, kill: int | None = None, every: int = 5) -> dict[str, torch.Tensor]:
    """One call of a training; killed before the batch of that number since it was called is drawn."""
    loss, drawn = Loss(), 0

    def sample():
        nonlocal drawn
        drawn += 1
        if drawn == kill:
            raise Killed
        return TensorDict({"x": torch.randn(4, 3)}, [4])

    torch.manual_seed(1)
    train_phase(
        "fit",
        loss,
        sample,
        num_steps=STEPS,
        learning_rate=1e-2,
        log_every=4,
        checkpoint_every=every,
        run=RunDirectory(folder),
        resume=True,
    )
    return {name: value.clone() for name, value in loss.state_dict().items()}


def rows(folder: Path) -> list[tuple[str, str]]:
    return [(row["step"], row["loss_fit"]) for row in RunDirectory(folder).read_metrics()]


class Resuming(RuleBasedStateMachine):
    """Whatever happens in between, a training ends with the weights and the log of one that was left alone."""

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp())
        self.wanted = train(self.root / "alone")
        self.run = self.root / "run"

    @property
    def checkpoint(self) -> Path:
        return self.run / "checkpoints" / "fit.safetensors"

    @rule(after=st.integers(1, STEPS), every=st.integers(1, STEPS + 3))
    def killed(self, after, every):
        try:
            train(self.run, kill=after, every=every)
        except Killed:
            pass

    @precondition(lambda self: self.checkpoint.exists())
    @rule(part=st.floats(0, 1), bit=st.integers(0, 7), cut=st.booleans())
    def damaged(self, part, bit, cut):
        """Damage is named and nothing else is touched; the file of before does again."""
        whole = self.checkpoint.read_bytes()
        place = min(int(part * len(whole)), len(whole) - 1)
        broken = bytearray(whole)
        broken[place] ^= 1 << bit
        self.checkpoint.write_bytes(whole[:place] if cut else bytes(broken))
        with pytest.raises(CheckpointError, match="fit.safetensors"):
            train(self.run)
        self.checkpoint.write_bytes(whole)

    @precondition(lambda self: (self.run / "metrics.csv").exists())
    @rule(length=st.integers(1, 12))
    def last_row_cut(self, length):
        """What a kill leaves of the row that was being written; a checkpoint comes after its row was complete."""
        path = self.run / "metrics.csv"
        with path.open("a") as file:
            file.write("fit,999,0.123456789"[:length])

    @rule()
    def leftovers(self):
        """A file that was being written aside when its process was killed."""
        (self.run / "checkpoints").mkdir(parents=True, exist_ok=True)
        (self.run / "checkpoints" / ".fit.safetensors.abc.tmp").write_bytes(os.urandom(20))

    @rule()
    def ends(self):
        found = train(self.run)
        assert all(torch.equal(found[name], self.wanted[name]) for name in self.wanted)
        assert rows(self.run) == rows(self.root / "alone")

    def teardown(self):
        self.ends()
        shutil.rmtree(self.root)


class Budgets(RuleBasedStateMachine):
    """However often labels are taken away, none comes back, and what is left is as it was."""

    @initialize(lengths=st.lists(st.integers(16, 24), min_size=2, max_size=6), seed=st.integers(0, 99))
    def recorded(self, lengths, seed):
        generator = torch.Generator().manual_seed(seed)
        observations = [torch.randn(length + 1, 3, generator=generator) for length in lengths]
        actions = [torch.randn(length, 2, generator=generator) for length in lengths]
        self.original = flatten_trajectories(observations, actions)
        self.data = self.original.clone()

    @rule(
        unit=st.sampled_from(["trajectory", "window", "transition"]), share=st.floats(0.05, 1.0), seed=st.integers(0, 5)
    )
    def spent(self, unit, share, seed):
        budget = LabelBudget(fraction=share, unit=unit, seed=seed)
        before = self.data.clone()
        try:
            data, report = budget.apply(self.data)
            again, _ = budget.apply(before)
        except ValueError:  # it selects nothing, or no window has all its labels any more
            return
        assert torch.equal(data["has_action"], again["has_action"])
        assert not (data["has_action"] & ~before["has_action"]).any()
        assert report.labelled_transitions == int(data["has_action"].sum()) > 0
        assert torch.equal(self.data["has_action"], before["has_action"])  # nothing was changed in place
        self.data = data

    @invariant()
    def nothing_leaks(self):
        if not hasattr(self, "data"):
            return
        shown = self.data["has_action"].squeeze(-1)
        assert torch.equal(self.data["action"][shown], self.original["action"][shown])
        assert self.data["action"][~shown].isnan().all()
        assert torch.equal(self.data["observation"], self.original["observation"])


QUICK = settings(max_examples=5, stateful_step_count=6, deadline=None, suppress_health_check=list(HealthCheck))
LONG = settings(QUICK, max_examples=150, stateful_step_count=20)


@pytest.mark.timeout(1800)  # of the long ones, on a machine with other work
@pytest.mark.parametrize("how", [QUICK, pytest.param(LONG, marks=pytest.mark.faults)], ids=["quick", "long"])
@pytest.mark.parametrize("machine", [Resuming, Budgets])
def test_in_any_order(machine, how):
    case = machine.TestCase
    case.settings = how
    case().runTest()
