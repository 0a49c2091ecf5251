# This source code is licensed under the MIT license found in the LICENSE file.
"""Held-out errors of ridge regressions, groups of rows left out one after the other, without fitting again."""

from __future__ import annotations

import torch
from torch import Tensor


def thin_svd(matrix: Tensor, *, wide: int) -> tuple[Tensor, Tensor, Tensor]:
    """Thin singular value decomposition, by whichever product is small where one side is much longer than the other.

    Args:
        matrix (Tensor): ``[N, m]``.

    Keyword Args:
        wide (int): columns above which the products of the rows are decomposed, if there are few enough of these.

    Returns:
        tuple: left vectors ``[N, r]``, singular values ``[r]`` in descending order and right vectors ``[r, m]``.
            Directions that are lost in rounding are left out: below a millionth of the largest singular value by
            products of rows, below a billionth of it where there are many rows.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.koopman.held_out_errors import thin_svd
        >>> matrix = torch.randn(50, 3, dtype=torch.float64)
        >>> left, singular, right = thin_svd(matrix, wide=2048)
        >>> bool(((left * singular) @ right - matrix).abs().max() < 1e-12)
        True
    """
    rows, columns = matrix.shape
    if columns > max(wide, 2 * rows):
        values, left = torch.linalg.eigh(matrix @ matrix.mT)
        kept = values > 1e-12 * values[-1].clamp_min(1e-300)
        singular, left = values[kept].flip(0).sqrt(), left[:, kept].flip(-1)
        return left, singular, (left.mT @ matrix) / singular[:, None]
    if rows <= 4 * columns:
        return torch.linalg.svd(matrix, full_matrices=False)
    triangle = torch.linalg.qr(matrix, mode="r").R
    _, singular, right = torch.linalg.svd(triangle)
    kept = singular > 1e-9 * singular[0].clamp_min(1e-300)
    singular, right = singular[kept], right[kept]
    return matrix @ (right.mT / singular), singular, right


def held_out_errors(left: Tensor, shrinks: Tensor, target: Tensor, groups: Tensor, *, centred: bool) -> Tensor:
    r"""Mean squared errors of ridge regressions on every group of rows, predicted without it.

    With the left singular vectors ``U`` and the shrinkages ``s`` of the directions a ridge predicts
    :math:`\hat Y = H Y`, :math:`H = U \mathrm{diag}(s) U^T`. Rows ``G`` left out have the errors
    :math:`(I - H_{GG})^{-1} (Y - \hat Y)_G`, exactly. For a group of more rows than there are directions the smaller
    system is solved (Woodbury's identity, with :math:`V = U_G \mathrm{diag}(s)^{1/2}`):

    .. math::
        (I - V V^T)^{-1} E = E + V (I - V^T V)^{-1} V^T E

    Args:
        left (Tensor): left singular vectors of what is regressed on, ``[N, r]``.
        shrinks (Tensor): shrinkages of the directions between 0 and 1, a row for every regression, ``[P, r]``.
        target (Tensor): ``[N, act]``, without their mean where that is fitted.
        groups (Tensor): group of every row, int64 ``[N]``.

    Keyword Args:
        centred (bool): whether the mean is fitted too; it counts as one more direction that is not shrunk.

    Returns:
        Tensor: ``[P, act]``; infinite where nothing is left to take a mean of.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.koopman.held_out_errors import held_out_errors
        >>> left = torch.linalg.qr(torch.randn(30, 2, dtype=torch.float64)).Q
        >>> target, groups = left @ torch.ones(2, 1, dtype=torch.float64), torch.arange(30) // 10
        >>> shrinks = torch.tensor([[1.0, 1.0], [0.5, 0.5]], dtype=torch.float64)
        >>> errors = held_out_errors(left, shrinks, target, groups, centred=False)
        >>> bool(errors[0] < 1e-20), bool(errors[1] > 1e-4)  # the first fits exactly, the second is shrunk
        (True, True)
    """
    coefficients = shrinks.unsqueeze(-1) * (left.mT @ target)  # [P, r, act]
    if centred and len(left) == 1:
        return target.new_full((len(shrinks), target.shape[1]), torch.inf)
    constant = len(left) ** -0.5 if centred else 0.0  # the mean's direction, in every row
    sizes = groups.bincount()
    if int(sizes.max()) == 1:  # single rows: the leverages are all that is needed
        leverage = left.square() @ shrinks.mT + constant**2
        errors = [
            (target - left @ c) / (1 - h[:, None]) for c, h in zip(coefficients, leverage.unbind(-1), strict=True)
        ]
        return torch.stack([error.square().mean(0) for error in errors])
    if centred:
        shrinks = torch.cat([shrinks, shrinks.new_ones(len(shrinks), 1)], -1)
    roots = shrinks.sqrt().unsqueeze(-1)  # [P, r, 1]
    total = target.new_zeros(len(shrinks), target.shape[1])
    for rows in groups.argsort(stable=True).split(sizes.tolist()):
        part = left[rows]
        error = target[rows] - part @ coefficients  # [P, |G|, act]
        if centred:
            part = torch.cat([part, part.new_full((len(part), 1), constant)], -1)
        if len(part) > part.shape[1]:
            inner = roots * (part.mT @ part) * roots.mT
            error = error + part @ (roots * _solve(inner, roots * (part.mT @ error)))
        else:
            error = _solve((part * shrinks.unsqueeze(1)) @ part.mT, error)
        total += error.square().sum(1)
    return total / len(left)


def _solve(hat: Tensor, right: Tensor) -> Tensor:
    """Solves ``I - hat``, symmetric and positive but for rounding."""
    keep = -hat
    keep.diagonal(dim1=-2, dim2=-1).add_(1)
    factor, info = torch.linalg.cholesky_ex(keep)
    return torch.linalg.solve(keep, right) if info.any() else torch.cholesky_solve(right, factor)
