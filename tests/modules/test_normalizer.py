# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests statistics against closed forms; constant columns, masks, state dicts, missing statistics."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from torchrl_koap.modules import Normalizer

DTYPES = (torch.float32, torch.float64)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(50, 3), (5, 10, 3), (1, 3)])
def test_ranges(shape, dtype):
    values = torch.randn(shape, dtype=dtype) * torch.tensor([1e-3, 1.0, 1e3], dtype=dtype) + 2
    out = Normalizer.fit(values)(values)
    assert out.dtype == dtype
    flat = out.flatten(0, -2)
    limit = 0.0 if len(flat) == 1 else 1.0
    torch.testing.assert_close(flat.amax(0), torch.full((3,), limit, dtype=dtype), atol=1e-3, rtol=0)
    torch.testing.assert_close(flat.amin(0), torch.full((3,), -limit, dtype=dtype), atol=1e-3, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_standard_and_rms(dtype):
    values = torch.randn(400, 2, dtype=dtype) * 3 + 7
    normalizer = Normalizer.fit(values, mode="standard")
    torch.testing.assert_close(normalizer.offset, values.mean(0))
    torch.testing.assert_close(normalizer.scale, values.std(0, correction=0))
    normalizer = Normalizer.fit(values, mode="rms")
    assert not normalizer.offset.any()
    torch.testing.assert_close(normalizer(values).square().mean(0), torch.ones(2, dtype=dtype))
    assert Normalizer.fit(torch.zeros(3, 1), mode="rms").scale.item() == 1.0


@pytest.mark.parametrize("mode", ["minmax", "standard", "shared", "rms", "moving"])
def test_many_columns_are_as_each_of_them(mode):
    values = torch.randn(300, 70) * torch.linspace(1, 5, 70)
    whole = Normalizer.fit(values, mode=mode)
    each = [Normalizer.fit(column, mode="standard" if mode == "shared" else mode) for column in values.split(1, -1)]
    torch.testing.assert_close(whole.offset, torch.cat([one.offset for one in each]))
    scale = torch.cat([one.scale for one in each])
    torch.testing.assert_close(whole.scale, scale.amax().expand(70) if mode == "shared" else scale)


def test_a_column_that_rarely_moves_is_scaled_by_how_far_it_moves_then():
    values = torch.tensor([5.0, 5.0, 0.0]).repeat(20_000, 1)
    values[::20, 0] = 5.0 + 3.0 * torch.tensor([1.0, -1.0]).repeat(500)
    values[::40, 1] += 2.0
    values[1::40, 1] += 0.001  # at rest, up to noise
    values[::20, 2] = 0.003  # in another unit
    normalizer = Normalizer.fit(values, mode="moving")
    torch.testing.assert_close(normalizer.offset, torch.tensor([5.0, 5.0, 0.0]))
    torch.testing.assert_close(normalizer.scale, torch.tensor([3.0, 2.0, 0.003]))


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3), min_size=1, max_size=20),
    st.sampled_from(["minmax", "standard", "rms", "shared", "moving"]),
)
def test_always_finite_and_invertible(rows, mode):
    values = torch.tensor(rows, dtype=torch.float64)
    normalizer = Normalizer.fit(values, mode=mode)
    out = normalizer(values)
    assert out.isfinite().all() and (normalizer.scale > 0).all()
    torch.testing.assert_close(normalizer.inverse(out), values, atol=1e-6, rtol=1e-9)


@pytest.mark.parametrize("mode", ["minmax", "standard"])
@pytest.mark.parametrize("constant", [0.0, 0.1, 12345.678, 1e-42])
def test_constant_columns_are_only_shifted(mode, constant):
    values = torch.rand(101, 2)
    values[:, 1] = constant
    normalizer = Normalizer.fit(values, mode=mode)
    assert normalizer.scale[1] == 1.0
    assert normalizer(values)[:, 1].abs().max() <= 1e-7 * max(constant, 1)
    unseen = normalizer(torch.tensor([[0.5, constant + 1.0]]))
    assert abs(unseen[0, 1].item() - 1) < 1e-2


@pytest.mark.parametrize("mode", ["minmax", "standard"])
def test_columns_constant_up_to_rounding_are_only_shifted(mode):
    values = torch.full((10, 1), 12345.678)
    values[3] = torch.nextafter(values[3], torch.tensor([torch.inf]))
    assert values[3] != values[0]
    assert Normalizer.fit(values, mode=mode).scale.item() == 1.0


def test_a_tiny_but_real_range_is_scaled():
    values = torch.linspace(0, 1e-5, 11).unsqueeze(-1)  # ten micrometres
    torch.testing.assert_close(Normalizer.fit(values)(values)[-1], torch.ones(1))


@pytest.mark.parametrize("trailing", [False, True])
def test_masks(trailing):
    values = torch.randn(6, 5, 2)
    mask = torch.rand(6, 5) > 0.5
    values[~mask] = float("nan")
    normalizer = Normalizer.fit(values, mode="standard", mask=mask.unsqueeze(-1) if trailing else mask)
    torch.testing.assert_close(normalizer.offset, values[mask].mean(0))
    with pytest.raises(ValueError, match="NaN or infinite, in columns"):
        Normalizer.fit(values)
    with pytest.raises(ValueError, match="no rows"):
        Normalizer.fit(values, mask=torch.zeros_like(mask))
    with pytest.raises(ValueError, match="mask must be bool"):
        Normalizer.fit(values, mask=mask.float())
    with pytest.raises(ValueError, match="mask must be bool"):
        Normalizer.fit(values, mask=mask[:3])


def test_wrong_input():
    values = torch.zeros(4, 2)
    values[2, 1] = float("inf")
    with pytest.raises(ValueError, match=r"1 of 4 rows are NaN or infinite, in columns \[1\]"):
        Normalizer.fit(values)
    with pytest.raises(ValueError, match="did you mean 'minmax'"):
        Normalizer.fit(torch.zeros(4, 2), mode="minmx")
    with pytest.raises(ValueError, match="float tensor"):
        Normalizer.fit(torch.zeros(4, 2, dtype=torch.int64))
    with pytest.raises(ValueError, match="float tensor"):
        Normalizer.fit(torch.zeros(4))
    with pytest.raises(ValueError, match="wanted 2 columns, got shape"):
        Normalizer.fit(torch.rand(4, 2))(torch.zeros(5, 3))
    with pytest.raises(ValueError, match=r"floating-point numbers, got torch.int64; cast them"):
        Normalizer.fit(torch.rand(4, 2))(torch.ones(5, 2, dtype=torch.int64))
    for offset, scale in ((torch.zeros(2), torch.ones(1)), (torch.zeros(1), torch.zeros(1))):
        with pytest.raises(ValueError, match="offset"):
            Normalizer(1, offset=offset, scale=scale)


def test_without_statistics_nothing_changes_until_they_are_loaded():
    policy, x = nn.Sequential(Normalizer(2), nn.Linear(2, 1)), torch.rand(7, 2)
    assert torch.equal(policy[0](x), x) and torch.equal(policy[0].inverse(x), x)
    with pytest.raises(RuntimeError, match=r'Missing key.*"0\.offset", "0\.scale"'):
        policy.load_state_dict({key: value for key, value in policy.state_dict().items() if key.startswith("1")})
    trained = nn.Sequential(Normalizer.fit(torch.rand(5, 2)), nn.Linear(2, 1))
    policy.load_state_dict(trained.state_dict())
    assert torch.equal(policy(x), trained(x))


def test_shared_keeps_how_much_larger_one_column_is_than_another():
    values = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([4.0, 1.0, 0.1]) + 7
    spread = Normalizer.fit(values, mode="shared")(values).std(0)
    assert spread[0].item() == pytest.approx(1, rel=1e-2)
    torch.testing.assert_close(spread / spread[0], values.std(0) / values[:, 0].std())
