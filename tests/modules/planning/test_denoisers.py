# This source code is licensed under the MIT license found in the LICENSE file.
"""Denoisers: shapes for any horizon and batch, dependence on time and condition."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules.planning.denoisers import ConditionEncoder, MLPDenoiser, StepEmbedding
from torchrl_koap.modules.planning.unet import TemporalUnet

MAKERS = {
    "unet": lambda **options: TemporalUnet(3, 6, channels=(16, 32), **options),
    "mlp": lambda **options: MLPDenoiser(3, 6, horizon=14, width=32, **options),
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
    torch.testing.assert_close(nested[1, 3], denoiser(x[1, 3], time[1, 3], condition[1, 3]), atol=1e-5, rtol=1e-4)
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
    embedding = StepEmbedding(8)
    embedding.network = torch.nn.Identity()
    values = embedding(torch.tensor([0.0, 3.0]))
    torch.testing.assert_close(values[0], torch.tensor([0.0] * 4 + [1.0] * 4))
    torch.testing.assert_close(values[1, 0], torch.tensor(3.0).sin())
    torch.testing.assert_close(values.square().sum(-1), torch.full((2,), 4.0))
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
