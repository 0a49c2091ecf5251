# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the closed-form fit of a controller: which labels it uses, and how often."""

from dataclasses import replace

import pytest
import torch
from small_networks import controller_of, plain_task

from torchrl_koap.data import LabelBudget, cut_windows, flatten_trajectories, select_state
from torchrl_koap.modules.ridge import INPUT_NOISE, ridge
from torchrl_koap.tasks import Action, get_task
from torchrl_koap.training.closed_form import action_facts, fit_closed_form

LENGTHS = (25, 18, 31, 40, 22)
CONTROLLERS = [("koap", "default"), ("koap", "paper"), ("koap", "absolute"), ("linear", "default")]


@pytest.fixture
def fits(monkeypatch):
    made = []

    def noted(inputs, targets, **options):
        made.append((inputs, targets, options["groups"], ridge(inputs, targets, **options)))
        return made[-1][-1]

    for module in ("koopman.inverse_dynamics", "baselines.regression"):
        monkeypatch.setattr(f"torchrl_koap.modules.{module}.ridge", noted)
    return made


def numbered(lengths=LENGTHS):
    generator = torch.Generator().manual_seed(0)
    frames = [torch.randn(n + 1, 4, generator=generator).cumsum(0) * 0.01 for n in lengths]
    counts = torch.arange(1.0, sum(lengths) + 1).split(list(lengths))
    data = flatten_trajectories(frames, [torch.stack([count, -count], 1) for count in counts])
    return select_state(data, (2, 3))


@pytest.mark.parametrize(("method", "preset"), CONTROLLERS)
@pytest.mark.parametrize(
    "budget",
    [
        LabelBudget(count=2),
        LabelBudget(count=3, unit="window"),
        LabelBudget(fraction=0.3, unit="transition"),
        LabelBudget(),
    ],
)
def test_every_label_with_full_look_ahead_is_used_exactly_once(fits, method, preset, budget):
    data = numbered()
    labelled, _ = budget.apply(data)
    torch.manual_seed(0)
    controller = controller_of(method, labelled, preset=preset)
    report = fit_closed_form(controller, labelled)
    *others, (inputs, targets, groups, _) = fits  # several kernels see the same labels
    assert all(torch.equal(targets, other) for _, other, *_ in others)
    actions = controller.raw_action(targets)
    look_ahead = controller.num_window_frames - 1 - controller.num_past
    left = torch.cat([torch.arange(n, 0, -1) for n in LENGTHS])  # steps that are left in the trajectory, this included
    wanted = labelled["has_action"].squeeze(-1) & (left > look_ahead)
    assert actions[:, 0].round().int().sort().values.tolist() == (wanted.nonzero().flatten() + 1).tolist()
    assert torch.equal(groups, data["episode"][actions[:, 0].round().long() - 1])
    assert report["labels_used"] == wanted.sum() > 0


@pytest.mark.parametrize(
    ("method", "noise"),
    [("koap", INPUT_NOISE), ("linear", INPUT_NOISE), ("pca", INPUT_NOISE), ("linear_steps", 1e-5)],
)
def test_no_penalty_is_below_that_of_the_errors_of_plans(fits, method, noise):
    generator = torch.Generator().manual_seed(0)
    frames = [torch.randn(91, 2, generator=generator).cumsum(0) * 0.01 for _ in range(6)]
    data = select_state(flatten_trajectories(frames, [frame[1:] - frame[:-1] for frame in frames]), (0, 1))
    torch.manual_seed(0)
    controller = controller_of(method, data)
    windows = cut_windows(data, controller.num_window_frames, pad_before=controller.num_past)["state"]
    controller.prepare(windows), controller.finish(windows)
    report = fit_closed_form(controller, data)
    assert report["labels_used"] > 400
    assert all(min(fit.errors) == pytest.approx(noise * report["labels_used"]) for *_, fit in fits)


def test_trajectories_without_a_label_are_not_cut():
    """There may be thousands of them, and any is too short for the frames that a controller reads."""
    data = numbered((30, 40, 3))
    data["has_action"][-3:], data["action"][-3:] = False, torch.nan
    torch.manual_seed(0)
    controller = controller_of("koap", numbered())
    assert fit_closed_form(controller, data) == fit_closed_form(controller, data[:-3])


@pytest.mark.parametrize("method", ["koap", "linear", "pca"])
def test_actions_that_are_not_alike_have_a_penalty_each(monkeypatch, method):
    asked = []

    def noted(*args, alike, **options):
        asked.append(alike)
        return ridge(*args, alike=alike, **options)

    for module in ("koopman.inverse_dynamics", "baselines.regression"):
        monkeypatch.setattr(f"torchrl_koap.modules.{module}.ridge", noted)
    controller = controller_of(method, numbered())
    for alike in (True, False):
        asked.clear()
        fit_closed_form(controller, numbered(), alike=alike)
        assert set(asked) == {alike}


@pytest.mark.parametrize(("preset", "through_zero"), [("default", True), ("paper", False)])
def test_no_motion_decodes_to_no_action_only_where_zero_is_zero(preset, through_zero):
    """With actions normalised by their root mean square, a bias would be an action out of nothing."""
    labelled, _ = LabelBudget(count=5).apply(numbered())
    torch.manual_seed(0)
    controller = controller_of("koap", labelled, preset=preset)
    fit_closed_form(controller, labelled)
    bias = controller.action_decoder.linear.bias
    assert (bias == 0).all() == through_zero


def test_columns_are_guessed_for_robots_without_a_simulator_alone():
    assert action_facts(get_task("avoiding"), range(4)) == {"axes": [0, 1], "guessed": False, "alike": True}
    stacking = get_task("stacking")
    assert action_facts(stacking, range(stacking.state_dim))["axes"] == []
    robot = replace(stacking, env=None, expert=None)
    assert action_facts(robot, range(8)) == {"axes": [*range(8)], "guessed": True, "alike": True}
    assert action_facts(robot, range(7))["axes"] == []
    # efforts move no column by a known amount
    raw = replace(plain_task(2, 2), robot=(0, 1), actions={"a": Action(kind="raw"), "b": Action(kind="raw")})
    assert action_facts(raw, range(2)) == {"axes": [], "guessed": True, "alike": False}
    assert action_facts(replace(raw, actions=raw.actions | {"b": Action()}), range(2))["alike"]


def test_of_very_many_labels_some_are_fitted_spread_over_all(fits, monkeypatch):
    monkeypatch.setattr("torchrl_koap.training.closed_form.MOST", 10)
    labelled, _ = LabelBudget().apply(numbered())
    controller = controller_of("linear", labelled)
    assert fit_closed_form(controller, labelled)["labels_used"] == 10
    ((_, targets, groups, _),) = fits
    assert groups.unique().tolist() == list(range(len(LENGTHS)))
    assert controller.raw_action(targets)[:, 0].diff().min() > 5
