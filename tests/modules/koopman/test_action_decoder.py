# This source code is licensed under the MIT license found in the LICENSE file.
"""The closed-form decoder: against numpy, against brute-force refits, and against the Bayesian formula."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import LinearActionDecoder

PENALTIES = (1e-4, 1e-2, 1.0)


def make_data(n=40, m=6, act=2, noise=0.3, seed=0):
    rng = np.random.default_rng(seed)
    latent = rng.normal(size=(n, m)) @ rng.normal(size=(m, m)) + rng.normal(size=m)
    action = latent @ rng.normal(size=(m, act)) + rng.normal(size=act) + noise * rng.normal(size=(n, act))
    return latent, action


def fit(latent, action, mask=None, dtype=torch.float64, **options):
    decoder = LinearActionDecoder(latent.shape[-1], action.shape[-1]).to(dtype)
    mask = torch.ones(latent.shape[:-1], dtype=torch.bool) if mask is None else mask
    result = decoder.fit_ridge(torch.as_tensor(latent), torch.as_tensor(action), mask, **options)
    return decoder, result


def unit_of(latent, bias=True):
    centred = latent - latent.mean(0) if bias else latent
    return (centred**2).sum(-1).mean()


def solve(latent, action, ridge, bias=True):
    """Ridge regression with an unpenalised constant, by the normal equations of the extended matrix."""
    m = latent.shape[-1]
    extended = np.concatenate([latent, np.ones((len(latent), 1))], 1) if bias else latent
    penalty = ridge * np.eye(extended.shape[-1])
    if bias:
        penalty[m, m] = 0.0
    solution = np.linalg.solve(extended.T @ extended + penalty, extended.T @ action)
    return (solution[:m], solution[m]) if bias else (solution, np.zeros(action.shape[-1]))


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("n", "m"), [(40, 6), (6, 10), (2, 3)])
@pytest.mark.parametrize("penalty", PENALTIES)
def test_weights_against_the_normal_equations(n, m, penalty, bias):
    latent, action = make_data(n, m)
    decoder, result = fit(latent, action, penalties=(penalty,), bias=bias)
    weight, constant = solve(latent, action, penalty * unit_of(latent, bias), bias)
    np.testing.assert_allclose(decoder.linear.weight.detach().numpy().T, weight, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(decoder.linear.bias.detach().numpy(), constant, rtol=1e-7, atol=1e-9)
    assert result.penalty == penalty and result.num_labels == n


def test_input_noise_is_the_fit_to_many_noisy_copies():
    latent, action = make_data(60, 4, noise=0.1)
    noise = 0.02
    decoder, result = fit(latent, action, penalties=(1e-9,), input_noise=noise)
    rng = np.random.default_rng(1)
    centred, target = latent - latent.mean(0), action - action.mean(0)
    sigma = np.sqrt(noise * unit_of(latent))
    rows = rng.integers(60, size=60_000)
    seen = centred[rows] + sigma * rng.normal(size=(len(rows), 4))
    expected = np.linalg.lstsq(seen, target[rows], rcond=None)[0]
    without = np.linalg.lstsq(centred, target, rcond=None)[0]
    found = decoder.linear.weight.detach().numpy().T
    assert np.abs(found - expected).max() < 0.1 * np.abs(without - expected).max()
    assert result.penalty == pytest.approx(noise * 60)


def test_input_noise_leaves_out_smaller_penalties_alone():
    latent, action = make_data(200, 4, noise=0.1)
    free, floored = (fit(latent, action, input_noise=noise)[1] for noise in (0.0, 1e-6))
    assert min(free.errors) == pytest.approx(1e-6) and min(floored.errors) == pytest.approx(200e-6)
    assert all(floored.errors[penalty] == free.errors[penalty] for penalty in free.errors if penalty > 200e-6)
    with pytest.raises(ValueError, match="input_noise must be finite and not negative, got -1"):
        fit(latent, action, input_noise=-1.0)


def brute_force(latent, action, groups, penalty, bias):
    """Refits without each group, at the penalty of the whole set, and predicts what was left out."""
    ridge = penalty * unit_of(latent, bias)
    residual = np.empty_like(action)
    for group in np.unique(groups):
        out = groups == group
        weight, constant = solve(latent[~out], action[~out], ridge, bias)
        residual[out] = action[out] - latent[out] @ weight - constant
    return residual


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("size", [None, 2, 5, 20])
@pytest.mark.parametrize("m", [6, 60])
def test_held_out_errors_against_refits(size, bias, m):
    latent, action = make_data(40, m)
    rng = np.random.default_rng(3)
    groups = np.arange(40) if size is None else rng.permutation(np.arange(40) // size)
    given = None if size is None else torch.from_numpy(groups * 7 - 3)  # any numbers will do
    decoder, result = fit(latent, action, groups=given, penalties=PENALTIES, bias=bias)
    residuals = {penalty: brute_force(latent, action, groups, penalty, bias) for penalty in PENALTIES}
    for penalty, residual in residuals.items():
        assert result.errors[penalty] == pytest.approx(np.sqrt((residual**2).mean()), rel=1e-6)
    assert result.penalty == min(PENALTIES, key=lambda penalty: (residuals[penalty] ** 2).mean())
    expected = (residuals[result.penalty] ** 2).mean(0)
    np.testing.assert_allclose(result.noise_variance.numpy(), expected, rtol=1e-6)
    np.testing.assert_allclose(decoder.noise_variance.numpy(), expected, rtol=1e-6)


def test_groups_choose_a_stronger_penalty_where_steps_of_a_group_resemble_each_other():
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(6), 20)
    latent = rng.normal(size=(6, 30))[groups] + 0.01 * rng.normal(size=(120, 30))
    action = (latent[:, :2] + rng.normal(size=(6, 2))[groups]) + 0.01 * rng.normal(size=(120, 2))
    single = fit(latent, action)[1]
    grouped = fit(latent, action, groups=torch.from_numpy(groups))[1]
    assert grouped.penalty > single.penalty
    assert min(grouped.errors.values()) > 3 * min(single.errors.values())  # leaving out one step flatters


def test_few_groups():
    latent, action = make_data()
    one = torch.zeros(40, dtype=torch.int64)
    two = torch.arange(40) % 2
    assert fit(latent, action, groups=one, penalties=PENALTIES)[1].errors == pytest.approx(
        fit(latent, action, penalties=PENALTIES)[1].errors
    )
    for groups in (one, two):
        result = fit(latent, action, groups=groups, default_penalty=0.05)[1]
        assert result.penalty == 0.05 and list(result.errors) == [0.05]
    assert fit(latent, action, groups=torch.arange(40) % 3, default_penalty=0.05, penalties=PENALTIES)[
        1
    ].errors.keys() == set(PENALTIES)
    # groups are counted among the labelled steps
    mask = torch.arange(40) % 3 != 2
    assert list(fit(latent, action, mask, groups=torch.arange(40) % 3, default_penalty=0.05)[1].errors) == [0.05]


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("n", "m"), [(40, 6), (6, 10)])
def test_predictive_variance_against_the_bayesian_formula(n, m, bias):
    latent, action = make_data(n, m)
    decoder, result = fit(latent, action, penalties=(1e-2,), bias=bias)
    ridge = 1e-2 * unit_of(latent, bias)
    extended = np.concatenate([latent, np.ones((n, 1))], 1) if bias else latent
    prior = ridge * np.eye(extended.shape[-1])
    if bias:
        prior[m, m] = 0.0  # a flat prior on b
    covariance = np.linalg.inv(extended.T @ extended + prior)
    query = np.random.default_rng(5).normal(size=(3, 7, m)) * 2
    row = np.concatenate([query, np.ones((3, 7, 1))], -1) if bias else query
    leverage = np.einsum("abi,ij,abj->ab", row, covariance, row)
    expected = (1 + leverage)[..., None] * result.noise_variance.numpy()
    variance = decoder.predictive_variance(torch.from_numpy(query))
    assert variance.shape == (3, 7, 2)
    np.testing.assert_allclose(variance.numpy(), expected, rtol=1e-6)


def test_predictive_variance_survives_float32_beside_undetermined_directions():
    """Directions with variance 1e6 beside some with 1e-4: stored as a matrix in float32 the small ones would drown."""
    rng = np.random.default_rng(0)
    latent = rng.normal(size=(2000, 8)) @ rng.normal(size=(8, 60))
    action = latent[:, :2] + 0.1 * rng.normal(size=(2000, 2))
    decoder, result = fit(latent, action, dtype=torch.float32, penalties=(1e-9,))
    centred = latent - latent.mean(0)
    covariance = np.linalg.inv(centred.T @ centred + 1e-9 * unit_of(latent) * np.eye(60))
    leverage = np.einsum("ni,ij,nj->n", centred, covariance, centred)
    expected = (1 + 1 / 2000 + leverage)[:, None] * result.noise_variance.numpy()
    variance = decoder.predictive_variance(torch.from_numpy(latent).float()).numpy()
    np.testing.assert_allclose(variance, expected, rtol=1e-3)
    off = decoder.predictive_variance(torch.randn(10, 60))
    assert (off > 1e3 * result.noise_variance).all()  # off the eight directions nothing is known


def test_predictive_variance_is_calibrated():
    latent, action = make_data(2030, 6, noise=0.3)
    decoder, _ = fit(latent[:30], action[:30])
    test = torch.from_numpy(latent[30:])
    error = (decoder.linear(test) - torch.from_numpy(action[30:])).detach()
    score = (error.square() / decoder.predictive_variance(test)).mean()
    assert 0.5 < score < 2.0


def test_unlabelled_steps_are_not_read():
    latent, action = make_data()
    mask = torch.arange(40) % 3 == 0
    expected, reference = fit(latent[mask.numpy()], action[mask.numpy()])
    for poison in (np.nan, np.inf, 1e300):
        poisoned = action.copy()
        poisoned[~mask.numpy()] = poison
        decoder, result = fit(latent, poisoned, mask)
        for name, value in decoder.state_dict().items():
            assert torch.equal(value, expected.state_dict()[name]), name
        assert result.errors == reference.errors and result.num_labels == int(mask.sum())


def test_leading_dimensions_are_flattened():
    latent, action = make_data()
    mask = torch.arange(40) % 3 == 0
    groups = torch.arange(40) // 8
    expected = fit(latent, action, mask, groups=groups)[0].state_dict()
    decoder, _ = fit(latent.reshape(5, 8, 6), action.reshape(5, 8, 2), mask.reshape(5, 8), groups=groups.reshape(5, 8))
    for name, value in decoder.state_dict().items():
        assert torch.equal(value, expected[name]), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fits_in_double_and_stores_in_its_own_type(dtype):
    latent, action = make_data()
    reference, _ = fit(latent, action, penalties=(1e-2,))
    decoder, _ = fit(
        torch.from_numpy(latent).to(dtype), torch.from_numpy(action).to(dtype), dtype=dtype, penalties=(1e-2,)
    )
    assert {value.dtype for value in decoder.state_dict().values()} == {dtype}
    torch.testing.assert_close(decoder.linear.weight.double(), reference.linear.weight, rtol=1e-4, atol=1e-5)


def test_without_a_bias_zero_decodes_to_zero():
    latent, action = make_data()
    decoder, _ = fit(latent, action, bias=False)
    assert (decoder.linear(torch.zeros(6, dtype=torch.float64)) == 0).all()


def test_one_label_fits_the_mean_and_claims_nothing():
    latent, action = make_data(1)
    decoder, result = fit(latent, action)
    np.testing.assert_allclose(decoder.linear(torch.from_numpy(latent)).detach(), action)
    assert result.num_labels == 1 and (result.noise_variance == np.inf).all()
    assert (decoder.predictive_variance(torch.randn(3, 6).double()) == np.inf).all()


def test_constant_latent_actions_fit_the_mean():
    _, action = make_data()
    decoder, result = fit(np.ones((40, 6)), action)
    np.testing.assert_allclose(decoder.linear.bias.detach(), action.mean(0))
    assert (decoder.linear.weight == 0).all() and decoder.predictive_variance(torch.ones(6).double()).isfinite().all()
    assert min(result.errors.values()) == pytest.approx(np.sqrt(((action - action.mean(0)) ** 2).mean()) * 40 / 39)


def test_forward_and_keys_and_state_dict():
    latent, action = make_data()
    decoder, _ = fit(latent, action)
    other = LinearActionDecoder(6, 2, in_key=("a", "u"), out_key=("a", "v")).double()
    with pytest.raises(RuntimeError, match="fitted by fit_ridge"):
        other.predictive_variance(torch.zeros(6).double())
    other.load_state_dict(decoder.state_dict())
    latent = torch.from_numpy(latent).reshape(5, 8, 6)
    td = other(TensorDict({"a": {"u": latent}}, [5]))
    expected = latent @ decoder.linear.weight.T + decoder.linear.bias
    torch.testing.assert_close(td["a", "v"], expected)
    assert torch.equal(other.predictive_variance(latent), decoder.predictive_variance(latent))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": torch.zeros(40, dtype=torch.bool)}, "at least one labelled step, the mask selects none"),
        ({"mask": torch.ones(40, 1, dtype=torch.bool)}, "must share their leading shape"),
        ({"mask": torch.ones(40, dtype=torch.int64)}, "mask must be bool, got torch.int64"),
        ({"action": torch.full((40, 2), torch.nan)}, "labelled action that is not finite"),
        ({"latent": torch.full((40, 6), torch.nan)}, "latent action that is not finite"),
        ({"action": torch.zeros(39, 2)}, "must share their leading shape"),
        ({"groups": torch.zeros(39, dtype=torch.int64)}, r"groups must have the shape of mask \[40\], got \[39\]"),
        ({"penalties": (1.0, 0.0)}, "penalties must be positive and finite"),
        ({"penalties": ()}, "penalties must be positive and finite"),
        ({"default_penalty": -1.0}, "penalties must be positive and finite"),
    ],
)
def test_bad_input_is_explained_and_nothing_is_changed(change, message):
    latent, action = (torch.from_numpy(value) for value in make_data())
    arguments = {"latent": latent, "action": action, "mask": torch.ones(40, dtype=torch.bool)} | change
    decoder = LinearActionDecoder(6, 2).double()
    before = {name: value.clone() for name, value in decoder.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        decoder.fit_ridge(**arguments)
    for name, value in decoder.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0, equal_nan=True)
