# This source code is licensed under the MIT license found in the LICENSE file.
"""Finite scalar quantisation: as many codes as there should be, bounded, numbered, differentiable."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.modules import FiniteScalarQuantizer

LEVELS = [(8, 5, 5, 5), (3, 4), (6,), (5, 3, 8)]


def spread_values(count, width, dtype=torch.float64):
    return 5 * torch.rand(count, width, generator=torch.Generator().manual_seed(0), dtype=dtype) - 2.5


@pytest.mark.parametrize("levels", LEVELS)
def test_every_level_is_reached_and_no_other(levels):
    quantizer = FiniteScalarQuantizer(7, levels=levels, num_codebooks=1).double()
    grid = torch.linspace(-9, 9, 4001, dtype=torch.float64)[:, None].expand(-1, len(levels))
    codes = quantizer.quantize(grid)
    for column, count in enumerate(levels):
        half = count // 2
        expected = torch.arange(-half, count - half, dtype=torch.float64) / half
        assert torch.equal(codes[:, column].unique(), expected)
        assert (codes[1:, column] >= codes[:-1, column]).all()
    assert codes.abs().max() == 1


@pytest.mark.parametrize("levels", LEVELS)
def test_there_are_as_many_codes_as_the_product_of_the_levels(levels):
    quantizer = FiniteScalarQuantizer(7, levels=levels, num_codebooks=1)
    assert quantizer.num_codes == math.prod(levels)
    codes = quantizer.quantize(spread_values(60_000, len(levels), torch.float32))
    distinct = codes.unique(dim=0)
    assert len(distinct) == quantizer.num_codes  # equal codes are equal bit for bit
    indices = quantizer.codes_to_indices(distinct)
    assert indices.dtype == torch.int64
    assert torch.equal(indices.flatten().sort().values, torch.arange(quantizer.num_codes))
    assert torch.equal(quantizer.indices_to_codes(indices), distinct)


def test_codebooks_stand_side_by_side():
    quantizer = FiniteScalarQuantizer(7, levels=(3, 4), num_codebooks=2).double()
    indices = torch.cartesian_prod(torch.arange(12), torch.arange(12))
    codes = quantizer.indices_to_codes(indices)
    assert codes.shape == (144, 4) and len(codes.unique(dim=0)) == 144
    assert torch.equal(quantizer.codes_to_indices(codes), indices)
    single = FiniteScalarQuantizer(7, levels=(3, 4), num_codebooks=1).double()
    for place in range(2):
        assert torch.equal(codes[:, 2 * place : 2 * place + 2], single.indices_to_codes(indices[:, place : place + 1]))
    with pytest.raises(ValueError, match=r"indices must be \[\*B, 2\], got \[12\]"):
        quantizer.indices_to_codes(torch.arange(12))


def test_zero_is_the_code_zero_and_in_the_middle_of_its_level():
    quantizer = FiniteScalarQuantizer(7, num_codebooks=1).double()
    zero = torch.zeros(4, dtype=torch.float64)
    torch.testing.assert_close(quantizer.bound(zero), zero, atol=1e-15, rtol=0)
    assert (quantizer.quantize(zero) == 0).all()


def test_a_code_is_never_further_from_its_value_than_half_a_level():
    quantizer = FiniteScalarQuantizer(7).double()
    values = spread_values(5000, 8)
    rounded = quantizer.quantize(values) * (quantizer.levels // 2)
    assert (rounded - quantizer.bound(values)).abs().max() <= 0.5
    assert quantizer.quantize(torch.full((8,), 1e9)).isfinite().all()


def test_gradients_are_those_of_the_bounded_value():
    quantizer = FiniteScalarQuantizer(7, num_codebooks=1).double()
    values = spread_values(50, 4).requires_grad_()
    (straight,) = torch.autograd.grad(quantizer.quantize(values).sum(), values)
    levels = torch.tensor([8.0, 5.0, 5.0, 5.0], dtype=torch.float64)
    half_range, shift = (levels - 1) / 2, torch.tensor([math.atanh(0.5 / 3.5), 0, 0, 0], dtype=torch.float64)
    expected = half_range / (levels // 2) * (1 - torch.tanh(values.detach() + shift) ** 2)
    torch.testing.assert_close(straight, expected)
    quantizer(torch.randn(5, 7, dtype=torch.float64)).sum().backward()
    assert all(value.grad.isfinite().all() and (value.grad != 0).any() for value in quantizer.parameters())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_dimensions_types_and_state_dict(dtype):
    torch.manual_seed(0)
    quantizer = FiniteScalarQuantizer(16).to(dtype)
    features = torch.randn(2, 3, 4, 16, dtype=dtype)
    out = quantizer(features)
    assert out.shape == features.shape and out.dtype == dtype
    torch.testing.assert_close(quantizer(features[1, 2, 3]), out[1, 2, 3])
    codes = quantizer.encode(features)
    torch.testing.assert_close(quantizer.project_out(codes), out)
    assert codes.shape == (2, 3, 4, 8) and quantizer.codes_to_indices(codes).shape == (2, 3, 4, 2)
    other = FiniteScalarQuantizer(16).to(dtype)
    other.load_state_dict(quantizer.state_dict())
    assert torch.equal(other(features), out)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"levels": (8, 2)}, r"3 levels or more, got levels \(8, 2\)"),
        ({"levels": ()}, "3 levels or more"),
        ({"num_codebooks": 0}, "num_codebooks must be >= 1, got 0"),
    ],
)
def test_what_cannot_be_a_code_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        FiniteScalarQuantizer(16, **options)
