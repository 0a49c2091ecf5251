# This source code is licensed under the MIT license found in the LICENSE file.
"""Errors on hidden actions: the same steps for every controller, never a trajectory of the budget."""

from __future__ import annotations

import math

import pytest
import torch
from small_controllers import controller_of
from tensordict.nn import TensorDictModuleBase

from torchrl_koap.data import LabelBudget, flatten_trajectories, select_state
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import get_task
from torchrl_koap.training.action_errors import AFTER, BEFORE, hidden_action_errors, rmse_mm, write_analysis

LENGTHS = (25, 18, 31, 13, 22)


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
    assert report.trajectories_touched < 5
    controller = Copy(num_past)
    predicted, true = hidden_action_errors(controller, data, labelled)
    assert true[:, 0].tolist() == hidden_steps(data, labelled)
    assert torch.equal(predicted, true)  # the action of the current frame, not of a neighbour
    assert controller.num_frames == min(num_past, BEFORE) + 1 + AFTER
    assert rmse_mm(*hidden_action_errors(Copy(num_past, shift=2), data, labelled)) == pytest.approx(2000)


def test_actions_of_the_budget_are_not_even_looked_at():
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


def test_error_in_millimetres():
    predicted, true = torch.tensor([[0.001, 0.0], [0.0, 0.003]]), torch.zeros(2, 2)
    assert rmse_mm(predicted, true) == pytest.approx(math.sqrt((1 + 9) / 4))


def test_a_linear_world_is_predicted_by_the_ridge_and_written_down(tmp_path):
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
    run = RunDirectory(tmp_path)
    result = write_analysis(run, get_task("avoiding"), data, labelled, controller, (0, 1))
    assert result["ridge"] < 1e-2 < result["controller"]
    tensors, _ = load_tensors(tmp_path / "actions.safetensors")
    assert result["analysis_labels_read"] == len(tensors["true"]) == 150 - report.labelled_transitions - 3 * AFTER
    assert rmse_mm(tensors["predicted"], tensors["true"]) == pytest.approx(result["controller"], rel=1e-5)
    shown, _ = load_tensors(tmp_path / "demonstrations.safetensors")
    assert torch.equal(shown["labelled"], labelled["has_action"].squeeze(-1))
    assert torch.equal(shown["state"], data["state"]) and torch.equal(shown["episode"], data["episode"])
    assert torch.equal(shown["position"], data["observation"][:, 2:]) and "objects" not in shown


def test_tool_and_objects_of_demonstrations_are_kept_for_pictures(tmp_path):
    task = get_task("stacking")
    frames = torch.arange(40 * task.observation_dim).float().reshape(40, -1)
    data = select_state(flatten_trajectories([frames[:20], frames[20:]], [torch.zeros(19, 8)] * 2), task.state_of)
    labelled, _ = LabelBudget(fraction=1.0).apply(data)
    write_analysis(RunDirectory(tmp_path), task, data, labelled, Copy(1), (0, 1))
    shown, _ = load_tensors(tmp_path / "demonstrations.safetensors")
    assert torch.equal(shown["position"], data["observation"][:, 28:30])
    assert torch.equal(shown["objects"][:, 2], data["observation"][:, 16:18])  # the blue box


def test_with_a_label_in_every_trajectory_there_is_nothing_to_measure(tmp_path):
    data = counting()
    labelled, _ = LabelBudget(fraction=1.0).apply(data)
    result = write_analysis(RunDirectory(tmp_path), get_task("avoiding"), data, labelled, Copy(1), (0, 1))
    assert set(result) == {"note"}
    assert not (tmp_path / "actions.safetensors").exists()
