# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests a planner's training: number of scores, weights of columns, augmentation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap import PlannerConfig, TrainConfig, fit, make_demonstrations, train
from torchrl_koap.data import cut_windows, flatten_trajectories, save_demonstrations, select_state
from torchrl_koap.modules import MLPDenoiser, StatePlanner
from torchrl_koap.objectives import PlannerLoss
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import get_task
from torchrl_koap.training import planner as planner_file
from torchrl_koap.training.planner import augmentation, check_interval, column_weights, plan_score


@pytest.mark.parametrize(("steps", "batch_size", "every"), [(20_000, 512, 666), (4000, 256, 200), (100, 64, 100)])
def test_scores_take_a_twentieth_of_the_training(steps, batch_size, every):
    section = PlannerConfig(steps=steps, batch_size=batch_size)
    assert check_interval(section, solver_steps=10) == every
    forward_passes = 64 * 4 * 10 / every, batch_size
    assert every == steps or forward_passes[0] <= 0.05 * forward_passes[1]


def test_plans_between_recorded_ways_score_worse_than_their_error_says(monkeypatch):
    """Two ways part; the one held out is near the left one, and a plan in the middle is in nobody's recordings."""

    def way(side):
        along = torch.linspace(0, 1.5, 40).sin()
        return torch.stack([along, side * along], -1)

    task = make_demonstrations([way(1).numpy()] * 2, [np.zeros((39, 2))] * 2, control_hz=10)[1]
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8), state_dim=2)
    known, unseen = (
        select_state(flatten_trajectories(list(map(way, s)), None, action_dim=2), range(2)) for s in ([-1, 1], [-0.9])
    )
    score = plan_score(planner, unseen, cut_windows(known, 16, select=["state"], pad_before=1)["state"], task)
    _, future = planner.split_window(cut_windows(unseen, 16, select=["state"], pad_before=1)["state"])

    def judged(side):
        """The score of plans on a way, and their energy score alone."""
        plans = future * future.new_tensor([1.0, side / -0.9])
        monkeypatch.setattr(planner_file, "sample_sequences", lambda *_, samples: plans.expand(samples, -1, -1, -1))
        both = score(planner)
        with monkeypatch.context() as patch:
            patch.setattr(planner_file, "relative_distance", lambda *_: 1.0)
            return both, score(planner)

    (middle, middle_error), (left, left_error) = judged(-0.5), judged(-1.0)
    assert left < left_error < middle_error < middle


def test_standing_still_scores_one_and_the_distance_from_recordings_counts_squared(monkeypatch):
    paths = [np.random.default_rng(seed).normal(size=(30, 2)).cumsum(0) for seed in range(2)]
    data, task = make_demonstrations(paths, control_hz=10, action_dim=1)
    data = select_state(data, range(2))
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8), state_dim=2)
    score = plan_score(planner, data, cut_windows(data, 16, select=["state"], pad_before=1)["state"], task)
    monkeypatch.setattr(
        planner_file, "sample_sequences", lambda _, seen, samples: seen[None, :, -1:].expand(4, -1, 14, -1)
    )
    for distance in (1.0, 3.0):
        monkeypatch.setattr(planner_file, "relative_distance", lambda *_, far=distance: far)
        assert score(planner) == pytest.approx(distance**2)


def own_task(columns, robot):
    paths = [np.random.default_rng(seed).normal(size=(20, columns)).cumsum(0) for seed in range(3)]
    return make_demonstrations(paths, [path[1:, :2] for path in paths], control_hz=10, robot=robot)[1]


@pytest.mark.parametrize(
    ("task", "share"),
    [
        (own_task(9, (3, 4)), 1 / 3),
        (own_task(5, (0, 1, 2)), None),
        (own_task(6, (0, 1)), None),
        (get_task("sorting"), 1 / 3),
        (get_task("avoiding"), None),
    ],
)
def test_the_robot_counts_a_third_of_the_loss_or_more(task, share):
    weights = column_weights(task)
    assert (weights is None) == (share is None)
    if share is not None:
        assert weights[list(task.robot)].sum().item() == pytest.approx(share * weights.sum().item())
        assert len(weights.unique()) == 2


def test_a_planner_learns_with_these_weights(monkeypatch):
    paths = [np.random.default_rng(seed).normal(size=(30, 5)).cumsum(0) for seed in range(3)]
    data, task = make_demonstrations(paths, [path[1:, :1] for path in paths], control_hz=10, robot=(0,))

    def weights_of_a_planner():
        planner = fit(data, task, planner={"steps": 3}, controller={"steps": 0}, progress=False).planner
        return planner.denoiser.last.weight

    with_them = weights_of_a_planner()
    assert torch.equal(with_them, weights_of_a_planner())
    monkeypatch.setattr(planner_file, "column_weights", lambda task: None)
    assert not torch.equal(with_them, weights_of_a_planner())


def test_of_much_data_some_windows_are_as_good_as_all(monkeypatch):
    """All of them would take sixteen times the memory of the data."""
    paths = [np.random.default_rng(seed).normal(size=(60, 3)).cumsum(0) for seed in range(20)]
    data, task = make_demonstrations(paths, [np.diff(path, axis=0) for path in paths], control_hz=10, robot=range(3))
    taken, fit_normalizers = [], StatePlanner.fit_normalizers

    def noted(planner, windows):
        taken.append(len(windows))
        fit_normalizers(planner, windows)

    def scale():
        planner = fit(data, task, planner={"steps": 1}, controller={"steps": 0}, progress=False).planner
        return planner.plan_normalizer.scale

    monkeypatch.setattr(StatePlanner, "fit_normalizers", noted)
    every = scale()
    monkeypatch.setattr(planner_file, "MOST_WINDOWS", 300)
    torch.testing.assert_close(scale(), every, rtol=0.1, atol=0)
    assert taken == [18 * 58, 300]  # two trajectories are held out


@pytest.mark.parametrize(
    ("held_out", "kept"), [(0.3, "best.network"), (0.0, "loss.target_network_params")], ids=["best", "last"]
)
def test_averaged_weights_are_kept_and_of_these_the_best(held_out, kept, tmp_path, monkeypatch):
    monkeypatch.setattr(planner_file, "check_interval", lambda *_: 2)
    paths = [np.random.default_rng(seed).normal(size=(30, 2)).cumsum(0) for seed in range(4)]
    folder = save_demonstrations(tmp_path / "arm", paths, [path[1:] - path[:-1] for path in paths], control_hz=10)
    options = {"steps": 10, "batch_size": 8, "width": 8, "held_out": held_out, "learning_rate": 10.0}  # soon spoiled
    train(TrainConfig(out=tmp_path / "run", dataset=str(folder), method="linear", planner=PlannerConfig(**options)))
    weights = load_tensors(tmp_path / "run" / "planner.safetensors")[0]
    saved, name = load_tensors(tmp_path / "run" / "checkpoints" / "planner.safetensors")[0], "denoiser.last.weight"
    entries = [entry for entry in saved if entry.endswith(name) and torch.equal(saved[entry], weights[name])]
    assert entries == [f"{kept}.{name}"]


def test_a_planner_of_one_frame_plans_from_all_states_that_have_a_next_one(monkeypatch):
    batches, forward = [], PlannerLoss.forward
    monkeypatch.setattr(PlannerLoss, "forward", lambda self, batch: batches.append(batch) or forward(self, batch))
    lines = [np.arange(41.0)[:, None]] * 2
    data, _ = make_demonstrations(lines, [np.ones((40, 1))] * 2, control_hz=10)
    options = {"steps": 2, "frames": 1, "width": 8, "batch_size": 512, "held_out": 0.0}
    planner = fit(data, method="linear", planner=options, progress=False).planner
    assert planner.condition_normalizer.offset == planner.condition_normalizer.scale == 19  # from states 0 to 38
    torch.testing.assert_close(planner.plan_normalizer.offset.flatten(), torch.arange(1.0, 15))
    states = torch.cat([batch["state"] for batch in batches])
    assert (states.diff(dim=1) == 1).all() and states[:, 0].unique().tolist() == [*range(39)]


def test_observed_frames_are_on_their_way_back_where_there_is_no_simulator():
    paths = [np.random.default_rng(seed).normal(size=(20, 2)).cumsum(0) for seed in range(3)]
    own = make_demonstrations(paths, control_hz=10, action_dim=2)[1]
    for task, share in ((own, 0.7), (get_task("avoiding"), 1.0)):
        states = torch.rand(20, 16, task.state_dim)
        shift = augmentation(task, states)(TensorDict({"state": states.clone()}, [20]))["state"] - states
        torch.testing.assert_close(shift[:, 1], share * shift[:, 0], rtol=0, atol=1e-5)
        assert shift[:, 0].any()


def test_fingers_are_not_shifted_with_the_arm():
    task = get_task("stacking_unobserved_joints")
    states, (_, fingers) = torch.rand(20, 16, task.state_dim), task.gripper
    states[..., fingers] = 0.06  # holding something
    moved = augmentation(task, states)(TensorDict({"state": states.clone()}, [20]))["state"]
    assert (moved[..., fingers] == 0.06).all() and (moved[:, 1, :3] != states[:, 1, :3]).all()


def test_actions_turn_with_the_scene_and_lead_back_with_the_robot():
    task, states = get_task("aligning"), torch.rand(20, 16, get_task("aligning").state_dim)
    windows = TensorDict({"state": states, "action": states[..., :3].diff(dim=1, append=states[:, -1:, :3])}, [20])
    moved = augmentation(task, states, actions=True)(windows.clone())
    torch.testing.assert_close(moved["action"][:, :-1], moved["state"][..., :3].diff(dim=1))
    assert not torch.allclose(moved["action"], windows["action"])


def test_scenes_turn_and_like_objects_swap_for_planners():
    def augmented(task):
        torch.manual_seed(0)
        states = torch.rand(1, 16, task.state_dim).expand(50, -1, -1)
        return states, augmentation(task, states)(TensorDict({"state": states.clone()}, [50]))["state"]

    states, turned = augmented(get_task("aligning"))
    assert not torch.equal(turned[..., -3:], states[..., -3:])  # of the box
    task = get_task("sorting")
    still = replace(task, planar_parts=(), defaults=replace(task.defaults, recovery=0.0))
    states, swapped = augmented(still)
    assert torch.allclose(swapped.sort(-1).values, states.sort(-1).values, atol=1e-6)
    assert not torch.equal(swapped, states)


def test_scenes_stay_where_they_are_if_actions_could_not_turn_with_them():
    task, states = get_task("aligning"), torch.rand(20, 16, get_task("aligning").state_dim)
    unnamed = replace(task, actions={name: replace(action, column=None) for name, action in task.actions.items()})
    windows = TensorDict({"state": states.clone(), "action": torch.rand(20, 16, 3)}, [20])
    assert torch.equal(augmentation(unnamed, states, actions=True)(windows)["state"], states)


def test_the_robot_is_shifted_by_its_usual_step_in_any_unit_unless_the_task_says_how_far():
    windows = torch.from_numpy(np.random.default_rng(0).normal(size=(500, 16, 3))).cumsum(1)
    _, task = make_demonstrations([path.numpy() for path in windows[:3]], control_hz=10, action_dim=1, robot=(0, 2))

    def shift(task, unit):
        torch.manual_seed(0)
        states = windows * unit
        return (augmentation(task, states)(TensorDict({"state": states}, [500]))["state"] - states)[:, 1] / unit

    in_mm, in_m = shift(task, torch.tensor([1e3, 1.0, 50.0])), shift(task, torch.ones(3))
    torch.testing.assert_close(in_mm, in_m)
    assert 0.9 < in_m[:, 0].square().mean().sqrt() < 1.4 and (in_m[:, 1] == 0).all()
    told = replace(task, defaults=replace(task.defaults, recovery=0.004))
    assert 0.004 < shift(told, torch.ones(3))[:, 0].square().mean().sqrt() < 0.006
    assert get_task("avoiding").defaults.recovery == 0.004  # m: the cylinders stand close


def test_shifts_of_a_fast_robot_are_those_of_a_thirtieth_of_a_second():
    windows = torch.from_numpy(np.random.default_rng(0).normal(size=(500, 16, 2))).cumsum(1)

    def shifts(rate):
        torch.manual_seed(0)
        _, task = make_demonstrations([path.numpy() for path in windows[:3]], control_hz=rate, action_dim=1)
        return augmentation(task, windows)(TensorDict({"state": windows}, [500]))["state"] - windows

    slow, usual, fast = map(shifts, (10, 30, 120))
    torch.testing.assert_close(slow, usual)
    torch.testing.assert_close(fast[:, 1], 4 * usual[:, 1])
    torch.testing.assert_close(fast[:, 5], 4 * usual[:, 2])  # the same share is left after the same time


def test_an_arm_is_turned_by_its_own_step_where_its_tool_is_shifted_by_another():
    task = get_task("stacking")
    states = torch.zeros(500, 16, task.state_dim).double()
    states[..., :7] = torch.tensor([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.8])
    states[..., task.tool_columns] = task.tool_position(states[..., :7])

    def shift(task):
        torch.manual_seed(0)
        found = augmentation(task, states)(TensorDict({"state": states.clone()}, [500]))["state"] - states
        return found[:, 1].square().mean(0).sqrt()

    turned, still = shift(task), shift(replace(task, defaults=replace(task.defaults, joint_recovery=0.0)))
    assert 0.03 < turned[6] < 0.04 and still[6] < 0.001  # rad; the last joint moves the tool by nothing
    torch.testing.assert_close(turned[list(task.tool_columns)], still[list(task.tool_columns)], rtol=0.1, atol=0)
