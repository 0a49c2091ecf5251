# This source code is licensed under the MIT license found in the LICENSE file.
"""Options of the planner: what they make of a task, and what is refused before any work."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_koap.data import GripperRecovery, NeighborRecovery, flatten_trajectories, select_state
from torchrl_koap.tasks import get_task
from torchrl_koap.training import TrainConfig, resolve
from torchrl_koap.training.diffusion_builders import build_planner
from torchrl_koap.training.planner import augmentation, learn_states


def planner_of(task="aligning", **options):
    resolved = resolve(TrainConfig(out=Path("run"), task=task, denoiser="mlp", denoiser_width=16, **options))
    facts = get_task(task)
    return resolved, build_planner(resolved.planner, facts.state_dim, facts.planner_features())


def demonstrations(task, count=3, length=25):
    torch.manual_seed(0)
    frames = [torch.randn(length, task.observation_dim, dtype=torch.float64).cumsum(0) / 20 for _ in range(count)]
    steps = [frame[1:, : task.action_dim] - frame[:-1, : task.action_dim] for frame in frames]
    return select_state(flatten_trajectories(frames, steps), task.state_of)


@pytest.mark.parametrize("frames", [1, 2])
def test_a_planner_learns_with_them(frames):
    resolved, planner = planner_of(steps=2, batch_size=4, observed_frames=frames)
    assert (planner.history, planner.horizon) == (frames, 14)
    before = planner.denoiser.last.weight.clone()
    losses = learn_states(planner, demonstrations(resolved.task), resolved.task, resolved.options)
    assert 0 < losses["loss_planner"] < 100 and not torch.equal(before, planner.denoiser.last.weight)


def test_a_task_brings_its_own_view_unless_another_is_named():
    resolved, planner = planner_of("sorting")  # names its denoiser
    assert resolved.options.observed_frames == planner.history == 1
    assert planner_of("sorting", observed_frames=2)[1].history == planner_of("avoiding")[1].history == 2
    for asked in ({"method": "dp"}, {"task": "stacking"}):
        assert resolve(TrainConfig(out=Path("run"), **({"task": "sorting"} | asked))).options.observed_frames is None


def test_the_view_of_a_task_is_checked_as_an_option_is():
    task = get_task("sorting")
    odd = replace(task, defaults=replace(task.defaults, view={"observed_frames": 3}))
    with pytest.raises(ValueError, match="observed_frames must be 1 to 2, got 3"):
        resolve(TrainConfig(out=Path("run"), task="sorting"), odd)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observed_frames": 3}, "observed_frames must be 1 to 2, got 3"),
        ({"observed_frames": 0}, "observed_frames must be 1 to 2, got 0"),
        ({"observed_frames": 1, "method": "dp"}, "observed_frames is the planner's, which method 'dp' does not have"),
    ],
)
def test_what_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        planner_of(**options)


def test_a_task_brings_its_own_planner_unless_one_is_named():
    def options(**given):
        return resolve(TrainConfig(out=Path("run"), label_count=1, **given)).options

    aligning, named = options(task="aligning"), options(task="aligning", denoiser="unet")
    assert (aligning.denoiser, aligning.denoiser_width, aligning.batch_size) == ("mlp", 512, 512)
    assert (named.denoiser, named.denoiser_width, named.batch_size, named.planner_learning_rate) == (
        *("unet", None, 128),
        3e-3,
    )
    mlp = options(task="avoiding", denoiser="mlp")
    assert (mlp.denoiser_width, mlp.batch_size, mlp.planner_learning_rate) == (512, 512, 1e-3)
    assert options(task="stacking", denoiser_width=64).denoiser_width == 64
    assert options(task="sorting", batch_size=16).batch_size == 16
    assert options(task="avoiding").denoiser == "unet"


@pytest.mark.parametrize(("task", "shares"), [("stacking", [0.1]), ("stacking_1", [0.1]), ("sorting", [])])
def test_tasks_with_a_gripper_have_it_for_their_planner(task, shares):
    def found(**options):
        return [step.share for step in augmentation(get_task(task), **options).module if type(step) is GripperRecovery]

    assert found() == shares and found(actions=True) == []


@pytest.mark.parametrize(("task", "shares"), [("scooping", [2.0]), ("scooping_moving_bowl", []), ("avoiding", [])])
def test_scooping_has_it_for_its_planner(task, shares):
    def found(**options):
        return [step.share for step in augmentation(get_task(task), **options).module if type(step) is NeighborRecovery]

    assert found() == shares and found(actions=True) == []


def test_a_batch_without_neighbours_is_refused_before_any_work():
    with pytest.raises(ValueError, match="batch_size: the neighbor_recovery of task 'scooping' looks for neighbours"):
        resolve(TrainConfig(out="run", task="scooping", batch_size=1))
    assert resolve(TrainConfig(out="run", task="scooping", method="dp", batch_size=1)).options.batch_size == 1
