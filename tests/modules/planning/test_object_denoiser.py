# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the denoiser of objects: order, kinds, columns in any place, actions, errors."""

import pytest
import torch

from torchrl_koap.modules.planning.object_denoiser import ObjectColumns, ObjectDenoiser
from torchrl_koap.runs.config import PlannerConfig
from torchrl_koap.tasks import get_task
from torchrl_koap.training.networks import build_planner, build_sampler

SECTION = PlannerConfig(network="objects", width=16, octaves=1, frames=2)


def boxes(kinds=(0, 0, 1)):
    """Returns three boxes of two columns; robot columns lie before, between and behind them."""
    return [
        ObjectColumns([first, first + 1], [first, first + 1, 9 + index], kind)
        for index, (first, kind) in enumerate(zip((1, 4, 6), kinds, strict=True))
    ]


def swapped(values, one, other):
    order = list(range(values.shape[-1]))
    for a, b in zip(one, other, strict=True):
        order[a], order[b] = b, a
    return values[..., order]


@pytest.fixture
def network():
    torch.manual_seed(0)
    return ObjectDenoiser(9, 12, objects=boxes(), horizon=14, width=16).double()


@pytest.fixture
def inputs():
    torch.manual_seed(1)
    options = {"dtype": torch.float64}
    return torch.randn(5, 14, 9, **options), 50 * torch.rand(5, **options), torch.randn(5, 12, **options)


@pytest.mark.parametrize(("pair", "alike"), [((0, 1), True), ((0, 2), False)])
def test_swapping_objects_swaps_their_plans_if_their_kind_is_the_same(network, inputs, pair, alike):
    (x, time, condition), (one, other) = inputs, (boxes()[index] for index in pair)
    plans = network(x, time, condition)
    again = network(swapped(x, one.sequence, other.sequence), time, swapped(condition, one.condition, other.condition))
    assert torch.allclose(again, swapped(plans, one.sequence, other.sequence)) == alike


def test_every_column_has_its_own_place(network, inputs):
    x, time, condition = inputs
    with torch.no_grad():
        for layer, size in ((network.robot_last, 3), (network.object_last, 2)):
            layer.weight.zero_()
            layer.bias.copy_(torch.arange(size).repeat(14))
    wanted = torch.tensor([0.0, 0, 1, 1, 0, 1, 0, 1, 2], dtype=torch.float64)  # robot, box, robot, box, box, robot
    torch.testing.assert_close(network(x, time, condition), wanted.expand_as(x))


def test_an_object_affects_the_plans_of_the_others(network, inputs):
    x, time, condition = inputs
    moved = condition.clone()
    moved[:, boxes()[2].condition[0]] += 1
    change = (network(x, time, moved) - network(x, time, condition)).abs().amax((0, 1))
    assert (change > 1e-6).all()


@pytest.mark.parametrize("name", ["sorting", "po_sorting", "sorting_6", "stacking", "aligning"])
def test_a_diffusion_policy_does_not_depend_on_the_order_of_boxes(name):
    task = get_task(name)
    torch.manual_seed(0)
    policy = build_sampler(task, SECTION).double()
    history, noise = torch.randn(4, 2, task.state_dim).double(), torch.randn(4, *policy.noise_shape).double()
    actions = policy.sample(history, noise)
    for group in task.interchangeable_columns():
        again = policy.sample(swapped(history, *group[:2]), noise)
        assert torch.allclose(actions, again) == (name != "stacking")  # there relative positions relate boxes


def test_a_robot_without_columns_and_one_object_are_enough():
    network = ObjectDenoiser(2, 2, objects=[ObjectColumns([0, 1], [0, 1])], horizon=14, width=8)
    assert network(torch.randn(3, 14, 2), torch.zeros(3), torch.randn(3, 2)).shape == (3, 14, 2)


def test_unfit_objects_are_refused(network, inputs):
    x, time, condition = inputs
    with pytest.raises(ValueError, match="must have 14 steps"):
        network(x[:, :12], time, condition)
    unequal = [*boxes()[:2], ObjectColumns([6, 7], [6, 7])]
    with pytest.raises(ValueError, match=r"equally many columns, got \[\(2, 2\), \(2, 3\)\]"):
        ObjectDenoiser(9, 12, objects=unequal, horizon=14)
    with pytest.raises(ValueError, match="equally many columns, got"):
        ObjectDenoiser(9, 12, objects=[], horizon=14)
    with pytest.raises(ValueError, match="'objects': no body of task 'avoiding' is in the state; use 'mlp'"):
        build_planner(get_task("avoiding"), SECTION)
