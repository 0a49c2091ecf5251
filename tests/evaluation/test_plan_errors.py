# This source code is licensed under the MIT license found in the LICENSE file.
"""Scores of plans on recorded trajectories."""

import pytest
import torch
from torch import nn

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.evaluation.plan_errors import plan_errors
from torchrl_koap.tasks import Action, Task

TASK = Task(
    name="arm",
    observation_parts={"joint": ("q",), "force": ("f",)},
    observation_units=("rad", "N"),
    actions={"dq": Action("rad")},
    position="joint",
)


class Planner(nn.Module):
    """Moves by +- ``size`` per step, with a sign that the noise draws."""

    horizon, noise_shape = 4, (4, 2)

    def __init__(self, size: float, history: int = 2):
        super().__init__()
        self.history = history
        self.register_buffer("size", torch.tensor(size))

    def split_window(self, window):
        return window[:, : self.history], window[:, self.history :]

    def sample(self, history, noise):
        sign = torch.where(noise[:, :1, :1] > 0, 1.0, -1.0) * torch.tensor([1.0, 0.0])
        return history[:, -1:] + sign * self.size * torch.arange(1.0, 5.0)[:, None]


def forked(count=20, steps=30):
    """Joints that move by +1 or -1 per step, a force that rests."""
    paths = [torch.arange(float(steps))[:, None] * torch.tensor([(-1.0) ** n, 0.0]) for n in range(count)]
    return flatten_trajectories(paths, [torch.zeros(steps - 1, 1)] * count)


def data():
    flat = forked()
    return flat.set("state", flat["observation"])


def test_both_ways_of_a_fork_are_no_mistake_and_units_stay_apart():
    found = plan_errors(Planner(1.0), data(), TASK, samples=16)
    joint, force = found["unit"]
    assert (joint["unit"], joint["columns"], force["unit"]) == ("rad", ["q"], "N")
    assert joint["standing_still"]["energy_score"]["per_step"] == pytest.approx([1, 2, 3, 4])
    assert joint["standing_still"]["best_of"]["overall"] == pytest.approx(2.5)
    # but for the first situation of each trajectory, whose earlier frame is the same, constant velocity is right
    assert joint["constant_velocity"]["energy_score"]["overall"] == pytest.approx(2.5 / 25, rel=1e-5)
    assert joint["planner"]["best_of"]["overall"] == pytest.approx(0)  # one of 16 went the right way
    # half of the samples are right: 0.5 * 2 k - 0.5 * (8 / 15) * 2 k
    assert joint["planner"]["energy_score"]["per_step"][3] == pytest.approx(4 * (1 - 8 / 15), rel=0.1)
    still, steady = (joint[name]["energy_score"]["overall"] for name in ("standing_still", "constant_velocity"))
    assert found["relative"] < 0.6 and steady < 0.1 * still
    assert plan_errors(Planner(0.0), data(), TASK)["relative"] == pytest.approx(1)
    assert force["planner"]["energy_score"]["overall"] == 0 and found["situations"] == 500
    assert len(found["trajectory"]) == 20


def test_a_planner_that_sees_one_frame_is_compared_with_constant_velocity_too():
    assert plan_errors(Planner(1.0, history=1), data(), TASK) == plan_errors(Planner(1.0), data(), TASK)


def test_the_same_seed_gives_the_same_figures():
    assert plan_errors(Planner(1.0), data(), TASK, seed=3) == plan_errors(Planner(1.0), data(), TASK, seed=3)
