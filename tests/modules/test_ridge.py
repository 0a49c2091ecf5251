# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests closed-form ridge regression against numpy, and its held-out errors against refits."""

import sys

import numpy as np
import pytest
import torch

from torchrl_koap.modules.ridge import RidgeFit, SharedFilter, held_out_errors, ridge, thin_svd

PENALTIES = (1e-4, 1e-2, 1.0)


def make_data(n=40, m=6, act=2, noise=0.3, seed=0):
    rng = np.random.default_rng(seed)
    latent = rng.normal(size=(n, m)) @ rng.normal(size=(m, m)) + rng.normal(size=m)
    action = latent @ rng.normal(size=(m, act)) + rng.normal(size=act) + noise * rng.normal(size=(n, act))
    return latent, action


def fit(latent, action, **options):
    return ridge(torch.as_tensor(latent), torch.as_tensor(action), **options)


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
    result = fit(latent, action, penalties=(penalty,), bias=bias)
    weight, constant = solve(latent, action, penalty * unit_of(latent, bias), bias)
    np.testing.assert_allclose(result.weight.numpy().T, weight, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(result.bias.numpy(), constant, rtol=1e-7, atol=1e-9)
    assert result.penalty == penalty and result.num_labels == n


def test_input_noise_leaves_out_smaller_penalties_alone():
    latent, action = make_data(200, 4, noise=0.1)
    free, floored = (fit(latent, action, input_noise=noise) for noise in (0.0, 1e-6))
    assert min(free.errors) == pytest.approx(1e-6) and min(floored.errors) == pytest.approx(200e-6)
    assert all(floored.errors[penalty] == free.errors[penalty] for penalty in free.errors if penalty > 200e-6)


def shared_filter() -> SharedFilter:
    """A filter of three steps of two axes, in six columns, and axes of different sizes."""
    basis = torch.zeros(3, 2, 6, dtype=torch.float64)
    for step in range(3):
        for axis in range(2):
            basis[step, axis, 2 * step + axis] = 1 + step + axis / 2
    return SharedFilter(basis, torch.tensor([1.0, 3.0], dtype=torch.float64))


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
@pytest.mark.parametrize("sizes", [None, [2] * 20, [5] * 8, [20] * 2, [1, 3, 27, 9]])
@pytest.mark.parametrize("m", [6, 60])
def test_held_out_errors_against_refits(sizes, bias, m):
    """Single rows, and groups of fewer and of more rows than directions, in any order."""
    latent, action = make_data(40, m)
    rng = np.random.default_rng(3)
    groups = np.arange(40) if sizes is None else rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    given = None if sizes is None else torch.from_numpy(groups * 7 - 3)  # any numbers will do
    result = fit(latent, action, groups=given, penalties=PENALTIES, bias=bias)
    residuals = {penalty: brute_force(latent, action, groups, penalty, bias) for penalty in PENALTIES}
    for penalty, residual in residuals.items():
        assert result.errors[penalty] == pytest.approx(np.sqrt((residual**2).mean()), rel=1e-6)
    assert result.penalty == min(PENALTIES, key=lambda penalty: (residuals[penalty] ** 2).mean())
    assert result.error == result.errors[result.penalty]


@pytest.mark.parametrize("sizes", [None, [5] * 80])
def test_many_rows_are_taken_some_at_a_time(monkeypatch, sizes):
    latent, action = make_data(400, 6)
    groups = None if sizes is None else torch.arange(80).repeat_interleave(5)
    at_once = fit(latent, action, groups=groups, prior=shared_filter())
    monkeypatch.setattr(sys.modules["torchrl_koap.modules.ridge"], "ROWS", 7)
    in_parts = fit(latent, action, groups=groups, prior=shared_filter())
    torch.testing.assert_close(in_parts.weight, at_once.weight)
    assert in_parts.errors == pytest.approx(at_once.errors)


def test_few_groups():
    latent, action = make_data()
    one = torch.zeros(40, dtype=torch.int64)
    two = torch.arange(40) % 2
    assert fit(latent, action, groups=one, penalties=PENALTIES).errors == pytest.approx(
        fit(latent, action, penalties=PENALTIES).errors
    )
    for groups in (one, two):
        result = fit(latent, action, groups=groups, default_penalty=0.05)
        assert result.penalty == 0.05 and list(result.errors) == [0.05]
    chosen = fit(latent, action, groups=torch.arange(40) % 3, default_penalty=0.05, penalties=PENALTIES)
    assert chosen.errors.keys() == set(PENALTIES)
    # groups are counted among the labelled steps
    mask = torch.arange(40) % 3 != 2
    labelled = fit(latent[mask], action[mask], groups=(torch.arange(40) % 3)[mask], default_penalty=0.05)
    assert list(labelled.errors) == [0.05]


def test_one_label_fits_the_mean_with_infinite_error():
    latent, action = make_data(1)
    result = fit(latent, action)
    np.testing.assert_allclose(result.predict(torch.from_numpy(latent)), action)
    assert result.num_labels == 1 and result.error == np.inf


def test_the_summary_keeps_the_digits_that_repeated_runs_reproduce():
    found = RidgeFit(torch.zeros(2, 3), torch.zeros(2), 0.1, {}, 1 / 3, 5).summary()
    assert found == {"penalty": 0.1, "labels_used": 5, "held_out_error": 0.333333}


def test_constant_latent_actions_fit_the_mean():
    _, action = make_data()
    result = fit(np.ones((40, 6)), action)
    np.testing.assert_allclose(result.bias, action.mean(0))
    assert (result.weight == 0).all()
    assert min(result.errors.values()) == pytest.approx(np.sqrt(((action - action.mean(0)) ** 2).mean()) * 40 / 39)


def test_a_ridge_around_a_shared_filter_is_a_ridge_around_zero_on_the_rest():
    latent, action = map(torch.from_numpy, make_data())
    shared = shared_filter()
    steps = torch.einsum("nm,sam->nsa", latent, shared.basis)
    weights = shared.fit(steps, action, torch.zeros(40, dtype=torch.int64))[0]
    prior = torch.einsum("s,sam->am", weights, shared.basis)
    around = ridge(latent, action, prior=shared, bias=False)
    rest = ridge(latent, action - latent @ prior.T, bias=False, penalties=(around.penalty,))
    torch.testing.assert_close(around.weight, rest.weight + prior)
    around = ridge(latent, action, prior=shared, bias=False, penalties=(1e9,))
    torch.testing.assert_close(around.weight, prior, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("sizes", [None, [5] * 8, [20] * 2, [1, 3, 27, 9]])
def test_rows_that_are_left_out_are_left_out_of_the_shared_filter_too(sizes, bias):
    latent, action = make_data()
    groups = np.arange(40) if sizes is None else np.repeat(np.arange(len(sizes)), sizes)
    shared, penalty = shared_filter(), 0.3
    found = fit(latent, action, groups=torch.from_numpy(groups), penalties=(penalty,), prior=shared, bias=bias)
    steps = np.einsum("nm,sam->nsa", latent, shared.basis.numpy())
    residual = np.empty_like(action)
    for group in np.unique(groups):
        out = groups == group
        rows, target = (steps * shared.sizes.numpy()), (action * shared.sizes.numpy())
        rows, target = rows[~out].transpose(0, 2, 1).reshape(-1, 3), target[~out].ravel()
        ridge_of_filter = 0.02 * (rows**2).sum(1).mean() * np.eye(3)
        weights = np.linalg.solve(rows.T @ rows + ridge_of_filter, rows.T @ target)
        rest = action - np.einsum("nsa,s->na", steps, weights)
        weight, constant = solve(latent[~out], rest[~out], penalty * unit_of(latent, bias), bias)
        residual[out] = rest[out] - latent[out] @ weight - constant
    assert found.error == pytest.approx(np.sqrt((residual**2).mean()))


@pytest.mark.parametrize(("size", "side"), [(2, 2), (5, 7)])  # six directions and the mean
def test_a_group_is_left_out_by_the_cheaper_system_with_a_column_per_target(monkeypatch, size, side):
    module, shapes = sys.modules["torchrl_koap.modules.ridge"], set()
    solve_system = module._solve

    def watched(hat, right):
        shapes.add((*hat.shape[1:], right.shape[-1]))
        return solve_system(hat, right)

    monkeypatch.setattr(module, "_solve", watched)
    fit(*make_data(), groups=torch.arange(40) // size, prior=shared_filter())
    assert shapes == {(side, side, 2)}  # the prior's three steps are combined first


@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.parametrize("sizes", [1, 5])
@pytest.mark.parametrize("right", [True, False])
def test_a_guessed_prior_is_used_only_where_it_lowers_the_held_out_error(right, sizes, alike):
    latent, action = map(torch.from_numpy, make_data(noise=3.0))
    shared, options = shared_filter(), {"groups": torch.arange(40) // sizes, "alike": alike}
    if right:  # the axes share a filter
        action = (
            torch.einsum("nm,sam,s->na", latent, shared.basis, torch.tensor([1.0, -1.0, 0.5]).double()) + action / 9
        )
    known, none = (ridge(latent, action, prior=prior, **options) for prior in (shared, None))
    guessed = ridge(latent, action, prior=shared, guessed=True, **options)
    assert (known.error < none.error) == right
    wanted = known if right else none
    torch.testing.assert_close((guessed.weight, guessed.bias), (wanted.weight, wanted.bias))
    assert (guessed.penalty, guessed.error) == pytest.approx((wanted.penalty, wanted.error))
    assert guessed.errors == pytest.approx(wanted.errors)


def test_a_shared_filter_of_axes_that_never_move_is_zero():
    still = shared_filter().fit(torch.zeros(6, 3, 2), torch.ones(6, 2), torch.arange(6) % 3)
    assert list(still.shape) == [4, 3] and not still.any()


def test_targets_that_are_not_alike_have_a_penalty_each():
    latent, action = make_data(60, 20)
    action[:, 1] = np.random.default_rng(1).normal(size=60)  # noise: a large penalty is best
    together, apart = (fit(latent, action, alike=alike) for alike in (True, False))
    alone = [fit(latent, action[:, [column]]) for column in (0, 1)]
    assert alone[0].penalty < together.penalty < alone[1].penalty
    torch.testing.assert_close(apart.weight, torch.cat([each.weight for each in alone]))
    torch.testing.assert_close(apart.bias, torch.cat([each.bias for each in alone]))
    assert apart.error == pytest.approx(np.sqrt(np.mean([each.error**2 for each in alone])))
    assert apart.error < together.error == together.errors[together.penalty]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": torch.zeros(0, 6), "targets": torch.zeros(0, 2)}, "at least one labelled step"),
        ({"inputs": torch.zeros(5, 8, 6)}, r"inputs must be \[n, m\]"),
        ({"targets": torch.full((40, 2), torch.nan)}, "a labelled action is not finite"),
        ({"inputs": torch.full((40, 6), torch.nan)}, "a labelled input is not finite"),
        ({"targets": torch.zeros(39, 2)}, r"targets \[n, act\]"),
        ({"groups": torch.zeros(39, dtype=torch.int64)}, r"groups must be \[40\], got \[39\]"),
        ({"prior": SharedFilter(torch.zeros(3, 2, 5), torch.ones(2))}, r"basis must be \[S, 2, 6\], got \[3, 2, 5\]"),
        ({"penalties": (1.0, 0.0)}, "penalties must be positive and finite"),
        ({"penalties": ()}, "penalties must be positive and finite"),
        ({"default_penalty": -1.0}, "penalties must be positive and finite"),
        ({"input_noise": -1e-8}, "input_noise must be a finite number >= 0"),
        ({"input_noise": float("nan")}, "input_noise must be a finite number >= 0"),
    ],
)
def test_bad_input_is_explained(change, message):
    inputs, targets = (torch.from_numpy(value) for value in make_data())
    with pytest.raises(ValueError, match=message):
        ridge(**({"inputs": inputs, "targets": targets} | change))


# held-out errors by themselves


def test_a_group_that_alone_knows_a_direction_still_has_an_error():
    left = torch.zeros(6, 2, dtype=torch.float64)
    left[:5, 0], left[5, 1] = 5**-0.5, 1.0
    groups, shrinks = torch.tensor([0, 0, 1, 1, 1, 2]), torch.tensor([[1.0, 1.0 - 1e-12]], dtype=torch.float64)
    target = torch.ones(6, 1, dtype=torch.float64)
    found = held_out_errors(left.__getitem__, shrinks, left.mT @ target, target, groups, centred=False)
    assert found.item() == pytest.approx(1 / 6, rel=1e-3)  # predicted as 0 without its own row; the others are exact


def test_systems_that_rounding_makes_indefinite_are_solved_all_the_same():
    left = torch.eye(4, dtype=torch.float64) * (1 + 1e-9)
    shrinks = torch.ones(1, 4, dtype=torch.float64)
    target, groups = torch.ones(4, 1).double(), torch.tensor([0, 0, 1, 1])
    found = held_out_errors(left.__getitem__, shrinks, left.mT @ target, target, groups, centred=False)
    assert found.item() == pytest.approx(1.0)  # each group alone knows its directions: predicted as 0 without them


def decompose(matrix, mean=0.0):
    mean = torch.zeros(matrix.shape[1]).double() + mean
    left, singular, right = thin_svd(matrix, mean)
    return left(torch.arange(len(matrix))), singular, right


@pytest.mark.parametrize(("rows", "columns"), [(90, 4), (9, 4), (4, 9), (3, 2100)])
def test_decomposition_equals_the_singular_value_decomposition(rows, columns):
    torch.manual_seed(0)
    matrix = torch.randn(rows, columns, dtype=torch.float64)
    left, singular, right = decompose(matrix)
    torch.testing.assert_close((left * singular) @ right, matrix)
    torch.testing.assert_close(left.mT @ left, torch.eye(len(singular)).double())
    torch.testing.assert_close(singular, torch.linalg.svdvals(matrix)[: len(singular)])


def test_directions_that_are_lost_in_rounding_are_left_out():
    matrix = torch.randn(60, 3, dtype=torch.float64)
    matrix = torch.cat([matrix, torch.zeros(60, 2).double(), matrix[:, :1]], -1)  # nothing, and one column twice
    left, singular, right = decompose(matrix)
    assert len(singular) == 3
    torch.testing.assert_close((left * singular) @ right, matrix)
    assert decompose(torch.zeros(60, 2).double())[1].numel() == 0
    wide = torch.randn(5, 2100, dtype=torch.float64)  # five centred rows span four directions
    left, singular, right = decompose(wide, wide.mean(0))
    assert len(singular) == 4
    torch.testing.assert_close((left * singular) @ right, wide - wide.mean(0))
