# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear decoder: the weights that it takes over, and what it writes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import LinearActionDecoder, ridge


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_of_a_fit_in_the_type_of_the_decoder(dtype):
    generator = torch.Generator().manual_seed(0)
    latent = torch.randn(40, 6, generator=generator, dtype=dtype)
    action = latent @ torch.randn(6, 2, generator=generator, dtype=dtype) + 1
    fit, decoder = ridge(latent, action, penalties=(1e-2,)), LinearActionDecoder(6, 2).to(dtype)
    decoder.assign(fit)
    assert {value.dtype for value in decoder.state_dict().values()} == {dtype}
    torch.testing.assert_close(decoder.linear.weight, fit.weight.to(dtype))
    torch.testing.assert_close(decoder.linear(latent), fit.predict(latent))


def test_forward_and_keys_and_state_dict():
    latent, decoder = torch.randn(5, 8, 6), LinearActionDecoder(6, 2)
    other = LinearActionDecoder(6, 2, in_key=("a", "u"), out_key=("a", "v"))
    other.load_state_dict(decoder.state_dict())
    assert set(other.state_dict()) == {"linear.weight", "linear.bias"}
    expected = latent @ decoder.linear.weight.T + decoder.linear.bias
    torch.testing.assert_close(other(TensorDict({"a": {"u": latent}}, [5]))["a", "v"], expected)
