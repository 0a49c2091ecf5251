# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests plan scores and action errors on recorded trajectories outside the label budget."""

import pytest
import torch
from small_networks import controller_of
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_koap.data import LabelBudget, flatten_trajectories, select_state
from torchrl_koap.evaluation.data_errors import (
    AFTER,
    BEFORE,
    episodes_outside,
    errors_left_out,
    errors_of_chunks,
    errors_outside_budget,
    first_actions,
    plan_errors,
    summarise_errors,
)
from torchrl_koap.modules import DiffusionPolicy, MLPDenoiser
from torchrl_koap.tasks import Action, Task, get_task

ARM = Task(
    name="arm",
    observation_parts={"joint": ("q",), "force": ("f",)},
    observation_units=("rad", "N"),
    actions={"dq": Action("rad")},
    position="joint",
)
LENGTHS = (25, 18, 31, 13, 22, 9, AFTER)  # the last two are too short


def hidden_action_errors(controller, data, labelled):
    return first_actions(controller, data, episodes_outside(data, labelled))[:2]


def rmse(predicted, true):
    return (predicted - true).square().mean().sqrt().item()


def counting(lengths=LENGTHS):
    """State and action both count the steps of all trajectories: the right action is the current state."""
    counts = torch.arange(1.0, sum(lengths) + 1).split(list(lengths))
    frames = [torch.cat([count, count[-1:] + 1])[:, None].expand(-1, 4) for count in counts]
    return select_state(flatten_trajectories(frames, [count[:, None].expand(-1, 2) for count in counts]), (2, 3))


class Copy(TensorDictModuleBase):
    """The action of a frame is the state of the frame ``shift`` further on."""

    def __init__(self, num_past, shift=0):
        super().__init__()
        self.in_keys, self.out_keys, self.num_past, self.shift = ["state"], ["action"], num_past, shift
        self.register_buffer("device_of", torch.zeros(1))

    def forward(self, tensordict):
        self.num_frames = tensordict["state"].shape[-2]
        return tensordict.set("action", tensordict["state"].roll(-self.shift, -2))


def hidden_steps(data, labelled):
    """The steps asked for, by definition."""
    touched = set(labelled["episode"][labelled["has_action"].squeeze(-1)].tolist())
    steps = []
    for row in range(len(data)):
        episode = data["episode"][row]
        left = int((data["episode"][row:] == episode).sum())
        if int(episode) not in touched and left > AFTER:
            steps.append(row + 1.0)
    return steps


@pytest.mark.parametrize(("amount", "unit"), [(2, "trajectory"), (1, "window"), (3, "transition")])
@pytest.mark.parametrize("num_past", [0, 1, 4, 7])
def test_the_same_hidden_steps_for_every_controller(num_past, amount, unit):
    data = counting()
    labelled, report = LabelBudget(count=amount, unit=unit, seed=2).apply(data)
    assert report.trajectories_touched < len(LENGTHS)
    controller = Copy(num_past)
    predicted, true = hidden_action_errors(controller, data, labelled)
    assert true[:, 0].tolist() == hidden_steps(data, labelled)
    assert torch.equal(predicted, true)  # the action of the current frame, not of a neighbour
    assert controller.num_frames == min(num_past, BEFORE) + 1 + AFTER
    assert rmse(*hidden_action_errors(Copy(num_past, shift=2), data, labelled)) == pytest.approx(2)


def test_actions_of_the_budget_are_not_read():
    data = counting()
    labelled, _ = LabelBudget(count=2).apply(data)
    poisoned = data.clone()
    touched = torch.isin(data["episode"], labelled["episode"][labelled["has_action"].squeeze(-1)])
    poisoned["action"][touched] = torch.nan
    predicted, true = hidden_action_errors(Copy(1), poisoned, labelled)
    assert torch.equal(predicted, true) and true.isfinite().all()


def test_the_first_frame_is_repeated_where_there_is_no_history():
    class First(Copy):
        def forward(self, tensordict):
            state = tensordict["state"]
            return tensordict.set("action", state[..., :1, :].expand_as(state))

    data = counting()
    labelled, _ = LabelBudget(count=1).apply(data)
    predicted, true = hidden_action_errors(First(4), data, labelled)
    steps = data["step_count"][true[:, 0].long() - 1]
    assert torch.equal(true - predicted, steps.clamp_max(4)[:, None].expand(-1, 2).float())


def test_a_linear_world_is_predicted_by_the_ridge():
    generator = torch.Generator().manual_seed(0)
    frames, actions = [], []
    for length in (40, 35, 30, 45):
        state = torch.randn(length + 9, 2, generator=generator).cumsum(0) * 0.01
        action = 0.3 * (state[8:] - state[:-8]) + 0.002
        frames.append(torch.cat([torch.full((length + 1, 2), 9.0), state[: length + 1]], 1))
        actions.append(action[:length])
    data = select_state(flatten_trajectories(frames, actions), (2, 3))
    labelled, report = LabelBudget(count=1).apply(data)
    torch.manual_seed(0)
    controller = controller_of("koap", labelled, preset="paper")
    result, tensors = errors_outside_budget(controller, data, labelled, get_task("avoiding"))
    (row,) = result["unit"]
    assert row["ridge"] < 1e-5 < row["controller"]
    assert result["labels"] == len(tensors["true"]) == 150 - report.labelled_transitions - 3 * AFTER
    assert rmse(tensors["predicted"], tensors["true"]) == pytest.approx(row["controller"], rel=1e-5)


def test_a_trajectory_left_out_is_judged_by_the_others_alone():
    data = counting((30, 40))
    data["action"] = torch.where(data["episode"].unsqueeze(-1) == 0, 1.0, -1.0).expand(-1, 2).clone()
    controller = controller_of("linear", data)
    before = {name: value.clone() for name, value in controller.state_dict().items()}
    found = errors_left_out(controller, data, get_task("avoiding"), (0, 1))
    assert found["labels"] == 70 - 2 * AFTER and found["trajectories"] == 2
    assert [found["unit"][0][name] for name in ("controller", "ridge", "mean_action")] == pytest.approx([2.0] * 3)
    after = controller.state_dict()
    assert all(torch.allclose(value, after[name], equal_nan=True) for name, value in before.items())


def label_last(data, episode, steps):
    """Hides all labels of a trajectory but those of its last steps."""
    rows = (data["episode"] == episode).nonzero().squeeze(-1)[:-steps]
    data["has_action"][rows], data["action"][rows] = False, torch.nan


def test_labels_near_the_end_that_no_fit_can_use_are_told():
    data, task = counting((30, 40)), get_task("avoiding")
    controller, every = controller_of("koap", data), data.clone()
    label_last(data, 1, 8)  # enough for the controller, not for the ridge, which looks 8 steps ahead
    assert errors_left_out(controller, data, task, (0, 1)) == {
        "note": "no labelled step has enough recorded future to decode its action"
    }
    label_last(data, 0, 8)
    hidden = data.clone().set("has_action", data["has_action"] & (data["episode"] == 1).unsqueeze(-1))
    note = {"note": "the ridge on raw frames cannot be fitted: no label is followed by 8 recorded steps"}
    assert errors_outside_budget(controller, every, hidden, task) == (note, {})


def test_an_action_that_never_changes_is_commanded_right_whatever_is_decoded():
    data = counting()
    data["action"][:, 1] = 7.0
    labelled, _ = LabelBudget(count=2).apply(data)
    task = Task(
        name="arm",
        observation_parts={"robot": 4},
        actions={"step": Action("m"), "grip": Action("N")},
        position="robot",
    )
    found, drawn = errors_outside_budget(Copy(1, shift=1), data, labelled, task, repeated=[1])
    assert [row["controller"] for row in found["column"]] == [1.0, 0.0]
    assert (drawn["predicted"][:, 1] == 7.0).all()


def test_few_of_many_labels_are_read_and_are_decoded_in_batches(monkeypatch):
    data, episodes, wanted = counting(), range(len(LENGTHS)), Copy(2, shift=1)
    everything = first_actions(wanted, data, episodes)
    monkeypatch.setattr("torchrl_koap.evaluation.data_errors._BATCH", 4)
    in_batches = first_actions(wanted, data, episodes)
    assert all(torch.equal(part, whole) for part, whole in zip(in_batches, everything, strict=True))
    monkeypatch.setattr("torchrl_koap.evaluation.data_errors._MOST_LABELS", 3)
    chosen = first_actions(wanted, data, episodes)
    total = len(everything[1])
    rows = [0, round((total - 1) / 2), total - 1]
    assert all(torch.equal(part, whole[rows]) for part, whole in zip(chosen, everything, strict=True))


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
    return select_state(flatten_trajectories(paths, [torch.zeros(steps - 1, 1)] * count), (0, 1))


def test_both_modes_of_a_fork_count_as_correct_and_units_are_not_mixed():
    found = plan_errors(Planner(1.0), forked(), ARM)
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
    assert plan_errors(Planner(0.0), forked(), ARM)["relative"] == pytest.approx(1)
    assert force["planner"]["energy_score"]["overall"] == 0 and found["situations"] == 500
    assert len(found["trajectory"]) == 20


def test_a_planner_that_sees_one_frame_is_compared_with_constant_velocity_too():
    assert plan_errors(Planner(1.0, history=1), forked(), ARM) == plan_errors(Planner(1.0), forked(), ARM)


class Jumping(Planner):
    """Draws a sign for every step of a plan."""

    def sample(self, history, noise):
        sign = torch.where(noise[:, :, :1] > 0, 1.0, -1.0) * torch.tensor([1.0, 0.0])
        return history[:, -1:] + sign * self.size * torch.arange(1.0, 5.0)[:, None]


def test_the_best_plan_is_one_plan_and_the_seed_draws_them():
    found, again, other = (plan_errors(Jumping(1.0), forked(), ARM, seed=seed) for seed in (0, 0, 1))
    best = found["unit"][0]["planner"]["best_of"]
    assert max(best["per_step"]) < 0.01 and best["overall"] > 0.2
    assert found == again != other


def test_trajectories_are_compared_in_one_unit():
    models = {"mean_action": torch.tensor([[1.0], [3.0]]), "controller": torch.ones(2, 1), "ridge": torch.zeros(2, 1)}
    found = summarise_errors(models, torch.zeros(2, 1), torch.tensor([4, 7]), ARM)
    assert found["relative"] == pytest.approx((1 / 5) ** 0.5) and found["ridge_relative"] == 0
    assert [row["episode"] for row in found["trajectory"]] == [4, 7]
    assert [row["relative_action_error"] for row in found["trajectory"]] == pytest.approx([found["relative"]] * 2)


def test_sampled_targets_are_judged_by_how_far_they_are_from_the_robot():
    paths = [torch.randn(30, 2).cumsum(0) for _ in range(5)]
    targets = [*(path[:-1] + 0.5 for path in paths[1:]), None]  # of the last one nobody knows any
    data = select_state(flatten_trajectories([*paths[1:], paths[0]], targets), (0, 1))
    actions = {name: Action("m", "absolute", column) for column, name in enumerate("xy")}
    task = Task(name="reach", observation_parts={"robot": 2}, actions=actions, position="robot")
    policy = DiffusionPolicy(MLPDenoiser(2, 4, horizon=14, width=8), state_dim=2, action_dim=2, num_steps=2)
    found = errors_of_chunks(policy, data, LabelBudget(count=2).apply(data)[0], task)
    assert found["trajectories"] == 2 and found["unit"][0]["mean_action"] == pytest.approx(0, abs=1e-5)
