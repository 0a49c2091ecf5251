# This source code is licensed under the MIT license found in the LICENSE file.
"""Held-out errors of ridge regressions against fits without the group, and the decomposition they start from."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules.koopman.held_out_errors import held_out_errors, thin_svd

SIZES = (1, 3, 30, 9)  # single rows, fewer and more rows than directions


def refit(matrix, target, groups, penalty, centred):
    """Mean squared errors of groups by ridge regressions on all other rows."""
    if centred:
        matrix = torch.cat([matrix, torch.ones(len(matrix), 1, dtype=matrix.dtype)], -1)
    free = torch.full((matrix.shape[1],), penalty, dtype=matrix.dtype)
    if centred:
        free[-1] = 0.0
    errors = torch.empty_like(target)
    for group in groups.unique():
        out = groups == group
        kept = matrix[~out]
        weight = torch.linalg.solve(kept.mT @ kept + free.diag(), kept.mT @ target[~out])
        errors[out] = target[out] - matrix[out] @ weight
    return errors.square().mean(0)


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("directions", [4, 12, 50])
def test_groups_of_any_size_in_any_order_against_refits(directions, centred):
    torch.manual_seed(0)
    groups = torch.arange(len(SIZES)).repeat_interleave(torch.tensor(SIZES))
    groups = groups[torch.randperm(len(groups))]
    matrix = torch.randn(len(groups), directions, dtype=torch.float64) @ torch.randn(directions, directions).double()
    target = torch.randn(len(groups), 2, dtype=torch.float64)
    mean = matrix.mean(0) if centred else torch.zeros(directions).double()
    shift = target.mean(0) if centred else torch.zeros(2).double()
    left, singular, _ = thin_svd(matrix - mean, wide=2048)
    penalties = (0.3, 5.0)
    shrinks = torch.stack([singular.square() / (singular.square() + penalty) for penalty in penalties])
    found = held_out_errors(left, shrinks, target - shift, groups, centred=centred)
    expected = torch.stack([refit(matrix, target, groups, penalty, centred) for penalty in penalties])
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


def test_a_group_that_alone_knows_a_direction_still_has_an_error():
    left = torch.zeros(6, 2, dtype=torch.float64)
    left[:5, 0], left[5, 1] = 5**-0.5, 1.0
    groups, shrinks = torch.tensor([0, 0, 1, 1, 1, 2]), torch.tensor([[1.0, 1.0 - 1e-12]], dtype=torch.float64)
    target = torch.ones(6, 1, dtype=torch.float64)
    found = held_out_errors(left, shrinks, target, groups, centred=False)
    assert found.item() == pytest.approx(1 / 6, rel=1e-3)  # predicted as 0 without its own row; the others are exact


def test_systems_that_rounding_makes_indefinite_are_solved_all_the_same():
    left = torch.eye(4, dtype=torch.float64) * (1 + 1e-9)
    shrinks = torch.ones(1, 4, dtype=torch.float64)
    found = held_out_errors(left, shrinks, torch.ones(4, 1).double(), torch.tensor([0, 0, 1, 1]), centred=False)
    assert found.isfinite().all()


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("size", [1, 5])
def test_features_that_never_move_leave_the_mean(size, centred):
    groups, target = torch.arange(20) // size, torch.randn(20, 3, dtype=torch.float64)
    left, singular, _ = thin_svd(torch.zeros(20, 2).double(), wide=2048)
    target = target - target.mean(0) if centred else target
    found = held_out_errors(left, singular.expand(2, -1), target, groups, centred=centred)
    factor = torch.stack([target[groups != group].mean(0) for group in groups]) if centred else 0.0
    torch.testing.assert_close(found, (target - factor).square().mean(0).expand(2, -1))


@pytest.mark.parametrize(("rows", "columns"), [(90, 4), (9, 4), (4, 9), (3, 50)])
def test_decomposition_is_one(rows, columns):
    torch.manual_seed(0)
    matrix = torch.randn(rows, columns, dtype=torch.float64)
    left, singular, right = thin_svd(matrix, wide=20)
    torch.testing.assert_close((left * singular) @ right, matrix)
    torch.testing.assert_close(left.mT @ left, torch.eye(len(singular)).double())
    torch.testing.assert_close(singular, torch.linalg.svdvals(matrix)[: len(singular)])


def test_directions_that_are_lost_in_rounding_are_left_out():
    matrix = torch.randn(60, 3, dtype=torch.float64)
    matrix = torch.cat([matrix, torch.zeros(60, 2).double(), matrix[:, :1]], -1)  # nothing, and one column twice
    left, singular, right = thin_svd(matrix, wide=2048)
    assert len(singular) == 3
    torch.testing.assert_close((left * singular) @ right, matrix)
    assert thin_svd(torch.zeros(60, 2).double(), wide=2048)[1].numel() == 0
