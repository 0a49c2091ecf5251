# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the table of methods: entries can be built and trained, unknown names raise errors."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from small_networks import controller_of, plain_task

from torchrl_koap import TrainConfig
from torchrl_koap.data import (
    LabelBudget,
    flatten_trajectories,
    make_demonstrations,
    make_window_buffer,
    select_state,
)
from torchrl_koap.keys import HAS_ACTION
from torchrl_koap.tasks import WINDOW
from torchrl_koap.training.controller import check_lengths
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import METHODS

CONTROLLERS = [name for name, method in METHODS.items() if method.plans and method.fit is None]


@pytest.fixture(scope="module")
def data():
    generator = torch.Generator().manual_seed(0)
    states = [torch.randn(41, 3, generator=generator).cumsum(0) for _ in range(4)]
    data = flatten_trajectories(states, [state.diff(dim=0)[:, :2] for state in states])
    return LabelBudget(count=2).apply(select_state(data, (0, 1, 2)))[0]


def make(name, data):
    torch.manual_seed(0)
    return controller_of(name, data, task=plain_task(3, 2))


def same(first, second):
    """Equal, where a decoder that was not fitted yet is NaN too."""
    return torch.allclose(first, second, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("name", METHODS)
def test_an_entry_holds_together(name):
    method = METHODS[name]
    assert method.title and len({other.title for other in METHODS.values()}) == len(METHODS)
    assert method.plans or not method.closed_form
    if method.plans:
        # every method has at most one controller's budget of updates, whatever it does with it
        assert sum(phase.share for phase in method.phases) == (1 if method.phases else 0)
        assert bool(method.phases) or method.closed_form or method.fit is not None
    if method.sees == "labelled":
        assert {phase.windows for phase in method.phases} == {"labelled"}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_phase_trains_what_acts_on_windows_with_and_without_labels(name, data):
    controller = make(name, data)
    for phase in METHODS[name].phases:
        loss = phase.loss(controller)
        window = max(WINDOW, controller.num_window_frames)
        share = {"all": None, "mixed": 0.25, "labelled": 1.0}[phase.windows]
        keys = ["state", "action", "has_action"]
        buffer = make_window_buffer(data, window, 8, select=keys, pad_before=controller.num_past, labelled_share=share)
        batch = buffer.sample()
        if phase.windows == "labelled":
            assert batch["has_action"].any((1, 2)).all()
        losses = loss(batch)
        total = sum(losses[key] for key in losses.keys() if key.startswith("loss_"))
        total.backward()
        gradients = [parameter.grad for parameter in loss.parameters() if parameter.grad is not None]
        assert total.isfinite() and gradients and all(gradient.isfinite().all() for gradient in gradients)
        assert any(gradient.abs().sum() > 0 for gradient in gradients)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_statistics_are_those_of_what_a_method_may_see(name, data):
    """Action statistics never depend on hidden labels; those of states depend on unlabelled ones where they may."""
    hidden = ~data["has_action"]
    other = data.clone()
    other["action"] = torch.where(hidden, 1e9, other["action"])
    moved = data.clone()
    moved["state"] = torch.where(hidden, moved["state"] * 3 + 1, moved["state"])
    clean, poisoned, shifted = (make(name, variant).state_dict() for variant in (data, other, moved))
    assert all(same(clean[key], poisoned[key]) for key in clean)
    changed = [key for key in clean if not same(clean[key], shifted[key])]
    assert not any(key.startswith("action_normalizer") for key in changed)
    if METHODS[name].sees == "labelled":
        assert not changed
    elif "state_normalizer.offset" in clean:
        assert "state_normalizer.offset" in changed


@pytest.mark.parametrize(("brake_at", "told"), [(25, True), (15, False)])
def test_a_switch_too_late_for_any_controller_is_named(brake_at, told):
    states = [np.random.default_rng(i).normal(size=(31, 2)).cumsum(0) for i in range(4)]
    brake = (np.arange(30) >= brake_at)[:, None]
    actions = [np.concatenate([np.diff(path, axis=0), brake], 1) if i < 3 else None for i, path in enumerate(states)]
    names = ["x", "y", "brake"]
    data, task = make_demonstrations(
        states, actions, control_hz=30, action_names=names, action_kind=["delta", "delta", "raw"]
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_lengths(task, resolve(TrainConfig(out=Path()), task), data)
    said = [str(each.message) for each in caught if "No controller is fitted" in str(each.message)]
    assert len(said) == told
    if told:
        assert "'brake' changes in the last 5 steps of 3 of 3 labelled recordings" in said[0]
        data[HAS_ACTION][data["action"][:, 2] == 1] = False  # hidden labels are not looked at
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_lengths(task, resolve(TrainConfig(out=Path()), task), data)
