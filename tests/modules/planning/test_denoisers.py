# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests denoisers: shapes, dependence on time and condition, features invariant to moved and turned scenes."""

import math

import pytest
import torch

from torchrl_koap.modules import StatePlanner
from torchrl_koap.modules.planning.denoisers import (
    NEAR,
    ConditionEncoder,
    MLPDenoiser,
    RelativePositionFeatures,
    StepEmbedding,
)
from torchrl_koap.modules.planning.object_denoiser import ObjectColumns, ObjectDenoiser
from torchrl_koap.modules.planning.unet import TemporalUnet
from torchrl_koap.tasks import TASKS, get_task

BOXES = [ObjectColumns([1], [1, 4]), ObjectColumns([2], [2, 5], 1)]
MAKERS = {
    "unet": lambda **options: TemporalUnet(3, 6, channels=(16, 32), **options),
    "mlp": lambda **options: MLPDenoiser(3, 6, horizon=14, width=32, **options),
    "objects": lambda **options: ObjectDenoiser(3, 6, horizon=14, width=32, objects=BOXES, **options),
}
DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()


@pytest.fixture(params=MAKERS)
def denoiser(request):
    torch.manual_seed(0)
    return MAKERS[request.param]()


def inputs(*batch, horizon=14, dtype=torch.float32, device="cpu"):
    options = {"dtype": dtype, "device": device}
    return (
        torch.randn(*batch, horizon, 3, **options),
        50 * torch.rand(batch, **options),
        torch.randn(*batch, 6, **options),
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extra_batch_dimensions_equal_flattened(denoiser, dtype, device):
    denoiser.to(dtype).to(device)
    x, time, condition = inputs(2, 5, dtype=dtype, device=device)
    nested = denoiser(x, time, condition)
    flat = denoiser(x.flatten(0, 1), time.flatten(), condition.flatten(0, 1))
    torch.testing.assert_close(nested.flatten(0, 1), flat)
    tolerance = {"atol": 1e-5, "rtol": 1e-4} if device == "cpu" else {"atol": 2e-3, "rtol": 2e-2}  # TF32 convolutions
    torch.testing.assert_close(nested[1, 3], denoiser(x[1, 3], time[1, 3], condition[1, 3]), **tolerance)
    assert nested.dtype == dtype and nested.shape == x.shape


def test_output_depends_on_every_input_and_reaches_every_parameter(denoiser):
    x, time, condition = (tensor.requires_grad_() for tensor in inputs(4))
    denoiser(x, time, condition).square().sum().backward()
    for tensor in (x, time, condition):
        assert (tensor.grad.flatten(1 if tensor.ndim > 1 else 0).abs().amax(-1) > 0).all()
    for name, parameter in denoiser.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_embeddings_in_closed_form():
    embedding = StepEmbedding()
    embedding.network = torch.nn.Identity()
    values = embedding(torch.tensor([0.0, 3.0]))
    torch.testing.assert_close(values[0], torch.tensor([0.0] * 16 + [1.0] * 16))
    torch.testing.assert_close(values[1, 0], torch.tensor(3.0).sin())
    torch.testing.assert_close(values.square().sum(-1), torch.full((2,), 16.0))
    encoder = ConditionEncoder(1, frequencies=2, width=4)
    encoder.network = torch.nn.Identity()
    torch.testing.assert_close(encoder(torch.tensor([[0.5]])), torch.tensor([[0.5, 1.0, 0.0, 0.0, -1.0]]))


def test_wrong_input_is_explained(denoiser):
    x, time, condition = inputs(2)
    with pytest.raises(ValueError, match=r"sequence must be \[\*B, H, 3\] \(state_dim\), got \[2, 14, 2\]"):
        denoiser(x[..., :2], time, condition)
    with pytest.raises(ValueError, match=r"condition must be \[2, 6\] \(\[\*B, condition_dim\]\), got \[2, 5\]"):
        denoiser(x, time, condition[:, :5])
    with pytest.raises(ValueError, match="must have 14 steps"):
        MAKERS["mlp"]()(x[:, :12], time, condition)


TOOL, BOX, YAW, GOAL_YAW = slice(0, 3), slice(3, 5), slice(5, 7), slice(7, 9)


def state(tool, box, yaw, goal_yaw=0.0):
    angles = [f(angle) for angle in (yaw, goal_yaw) for f in (math.cos, math.sin)]
    return torch.tensor([[*tool, *box, *angles]], dtype=torch.float64)


def test_a_position_seen_from_a_turned_box_by_hand():
    relations = RelativePositionFeatures([(TOOL, BOX, YAW, GOAL_YAW)])
    found = relations(state((0.5, 0.31, 0.2), (0.5, 0.3), math.pi / 2, goal_yaw=math.pi / 2 + 0.3))
    gap = torch.tensor([0.01, 0.0, 0.2], dtype=torch.float64)  # ahead of the box, which looks along y; height as it is
    wanted = torch.cat([torch.tensor([math.cos(0.3), math.sin(0.3)], dtype=torch.float64), gap])
    wanted = torch.cat([wanted, *(torch.tanh(gap / near) for near in NEAR)])
    torch.testing.assert_close(found, wanted)
    assert relations.num_features == len(found) == 11


def test_moving_and_turning_everything_changes_nothing():
    relations = RelativePositionFeatures([(slice(0, 2), BOX, YAW, GOAL_YAW)])
    angle, shift = 0.7, torch.tensor([0.2, -0.1], dtype=torch.float64)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    before = state((0.5, 0.31, 0.2), (0.45, 0.2), 0.4, 1.1)
    after = before.clone()
    for part in (slice(0, 2), BOX):
        after[:, part] = before[:, part] @ turn.T + shift
    for part in (YAW, GOAL_YAW):
        after[:, part] = before[:, part] @ turn.T
    torch.testing.assert_close(relations(before), relations(after))


def test_only_the_present_frame_counts_and_batches_are_kept():
    relations = RelativePositionFeatures([(TOOL, BOX)])
    history = torch.randn(2, 3, 4, 9)
    found = relations(history)
    assert found.shape == (2, 3, relations.num_features)
    history[..., :3, :] = torch.nan
    assert torch.equal(relations(history), found)


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.relative_positions])
def test_every_task_s_relations_fit_its_state_and_travel_with_the_planner(name):
    task = get_task(name)
    features = RelativePositionFeatures(task.relative_columns())
    width = 2 * task.state_dim + features.num_features
    planner = StatePlanner(
        TemporalUnet(task.state_dim, width, channels=(8, 16)), state_dim=task.state_dim, features=features
    )
    windows = torch.randn(50, 16, task.state_dim)
    planner.fit_normalizers(windows)
    assert planner.encode_history(windows[:5, :2]).shape == (5, width)
    assert planner.sample(windows[:5, :2]).shape == (5, 14, task.state_dim)


def test_a_network_of_another_width_is_named():
    class Narrow(MLPDenoiser):
        def denoise(self, x, step, condition):
            return super().denoise(x, step, condition)[..., :1]

    with pytest.raises(ValueError, match=r"denoise\(\) of Narrow must give \[4, 14, 3\], got \[4, 14, 1\]"):
        Narrow(3, 6, horizon=14, width=32)(*inputs(4))
