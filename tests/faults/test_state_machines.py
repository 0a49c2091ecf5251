# This source code is licensed under the MIT license found in the LICENSE file.
"""Label budgets one after the other, in any order."""

import pytest
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from torchrl_koap.data import LabelBudget, flatten_trajectories


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
def test_in_any_order(how):
    case = Budgets.TestCase
    case.settings = how
    case().runTest()
