# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the networks of the first public code as a plugin: sizes, frames read, training."""

import numpy as np
import pytest
import torch
from small_networks import plain_task

from torchrl_koap.data import make_demonstrations
from torchrl_koap.training import fit


@pytest.fixture(scope="module")
def first_code(benchmark_script):
    return benchmark_script("first_code")


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(("state_dim", "expected"), [(2, 1_387_524), (14, 1_412_112), (10, 1_403_916)])
def test_sizes_are_those_of_the_first_public_code(first_code, state_dim, expected):
    assert count(first_code.build(plain_task(state_dim, 2), range(state_dim), {}, "paper")) == expected


def test_parts_have_its_sizes_and_read_its_frames(first_code):
    model = first_code.build(plain_task(2, 2), range(2), {}, "paper")
    assert count(model.lifting.encoder) == 397_824 and count(model.lifting.decoder) == 788_994
    assert count(model.latent_action) == 199_168 and count(model.action_decoder) == 1_026
    assert count(first_code.build_supervised(plain_task(2, 2), range(2), {}, "paper")) == 266_754
    index = model.latent_action.gather(torch.arange(16.0)[:, None].expand(16, 2))[1:14, -1, 0]
    assert index.tolist() == [min(t + 7, 15) for t in range(1, 14)]  # x_{min(t - 1 + 8, 15)}
    assert model.valid_frames(16) == range(1, 14)


@pytest.mark.parametrize("method", ["first_code", "first_code_dd"])
def test_fit_trains_both_methods(first_code, method):
    states = [np.random.default_rng(i).normal(size=(40, 2)).cumsum(0) for i in range(3)]
    data, task = make_demonstrations(states, [np.diff(states[0], axis=0), None, None], control_hz=30)
    results = fit(data, task, method=method, planner=False, controller={"steps": 2}, progress=False).results
    assert results["controller_updates"] == 2 and results["controller"]["loss_action"] > 0
