# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear decoder: what its fit reads, and what it writes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import LinearActionDecoder, ridge


def make_data(n=40, m=6, act=2):
    generator = torch.Generator().manual_seed(0)
    latent = torch.randn(n, m, generator=generator).double()
    action = latent @ torch.randn(m, act, generator=generator).double() + 1
    return latent, action + 0.3 * torch.randn(n, act, generator=generator)


def fit(latent, action, mask, dtype=torch.float64, **options):
    decoder = LinearActionDecoder(latent.shape[-1], action.shape[-1]).to(dtype)
    return decoder, decoder.fit(latent, action, mask, **options)


def test_unlabelled_steps_are_not_read():
    latent, action = make_data()
    mask = torch.arange(40) % 3 == 0
    reference = ridge(latent[mask], action[mask])
    for poison in (np.nan, np.inf, 1e300):
        decoder, result = fit(latent, torch.where(mask[:, None], action, poison), mask)
        assert torch.equal(decoder.linear.weight, reference.weight) and torch.equal(decoder.linear.bias, reference.bias)
        assert result.errors == reference.errors and result.num_labels == int(mask.sum())


def test_leading_dimensions_are_flattened_and_groups_counted_among_the_labelled_steps():
    latent, action = make_data()
    mask, groups = torch.arange(40) % 3 == 0, torch.arange(40) // 8
    expected = fit(latent, action, mask, groups=groups)[0].state_dict()
    decoder, _ = fit(latent.view(5, 8, 6), action.view(5, 8, 2), mask.view(5, 8), groups=groups.view(5, 8))
    for name, value in decoder.state_dict().items():
        assert torch.equal(value, expected[name]), name
    mask, groups = torch.arange(40) % 3 != 2, torch.arange(40) % 3
    assert list(fit(latent, action, mask, groups=groups, default_penalty=0.05)[1].errors) == [0.05]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fits_in_double_and_stores_in_its_own_type(dtype):
    latent, action = make_data()
    every = torch.ones(40, dtype=torch.bool)
    decoder, result = fit(latent.to(dtype), action.to(dtype), every, dtype=dtype, penalties=(1e-2,))
    assert {value.dtype for value in decoder.state_dict().values()} == {dtype}
    torch.testing.assert_close(
        decoder.linear.weight.double(), ridge(latent, action, penalties=(1e-2,)).weight, rtol=1e-4, atol=1e-5
    )
    torch.testing.assert_close(decoder.linear(latent.to(dtype)), result.predict(latent.to(dtype)))


def test_forward_and_keys_and_state_dict():
    latent, action = make_data()
    decoder, _ = fit(latent, action, torch.ones(40, dtype=torch.bool))
    other = LinearActionDecoder(6, 2, in_key=("a", "u"), out_key=("a", "v")).double()
    other.load_state_dict(decoder.state_dict())
    assert set(other.state_dict()) == {"linear.weight", "linear.bias"}
    td = other(TensorDict({"a": {"u": latent.view(5, 8, 6)}}, [5]))
    expected = latent.view(5, 8, 6) @ decoder.linear.weight.T + decoder.linear.bias
    torch.testing.assert_close(td["a", "v"], expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": torch.zeros(40, dtype=torch.bool)}, "at least one labelled step"),
        ({"mask": torch.ones(40, 1, dtype=torch.bool)}, "must share their leading shape"),
        ({"mask": torch.ones(40, dtype=torch.int64)}, "mask must be bool, got torch.int64"),
        ({"action": torch.full((40, 2), torch.nan)}, "a labelled action is not finite"),
        ({"action": torch.zeros(39, 2)}, "must share their leading shape"),
        ({"groups": torch.zeros(39, dtype=torch.int64)}, r"groups must have the shape of mask \[40\], got \[39\]"),
    ],
)
def test_bad_input_is_explained_and_nothing_is_changed(change, message):
    latent, action = make_data()
    decoder = LinearActionDecoder(6, 2).double()
    before = {name: value.clone() for name, value in decoder.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        decoder.fit(**({"latent": latent, "action": action, "mask": torch.ones(40, dtype=torch.bool)} | change))
    for name, value in decoder.state_dict().items():
        assert torch.equal(value, before[name])
