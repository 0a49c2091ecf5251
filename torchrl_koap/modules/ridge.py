# This source code is licensed under the MIT license found in the LICENSE file.
"""Ridge regression in closed form; exact leave-one-out or leave-group-out errors choose the penalty."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

# with more columns than this, and far more columns than rows, the Gram matrix of the rows is decomposed
WIDE = 2048
ROWS = 8192  # least number of rows converted to float64 at once: all rows together may exceed the memory
PENALTIES = tuple(10.0 ** (p / 2) for p in range(-12, 3))
# used with one or two labelled trajectories, too few to choose the penalty by leaving one out
DEFAULT_PENALTY = 0.15
# variance of the errors of plans, which recorded steps do not contain, in units of the mean square norm of the inputs.
# With thousands of labelled steps, penalties chosen by recorded steps alone gave fewer successes in closed loop.
INPUT_NOISE = 1e-8
SHARED_PENALTY = 0.02  # assumed ratio of noise to signal variance for a filter that all axes share


@dataclass(frozen=True)
class RidgeFit:
    """A fitted ridge regression.

    Args:
        weight (Tensor): ``[act, m]``, float64.
        bias (Tensor): ``[act]``, float64.
        penalty (float): the best penalty for all targets, in units of the mean square norm of the inputs.
        errors (dict): root mean squared held-out error of every candidate penalty, in the units of the targets.
        error (float): that of the chosen penalty, or of the penalties chosen for each target; infinite for a single
            row with a bias, since no other row is left to fit the mean.
        num_labels (int): number of rows used.
    """

    weight: Tensor
    bias: Tensor
    penalty: float
    errors: dict[float, float]
    error: float
    num_labels: int

    def predict(self, inputs: Tensor) -> Tensor:
        """Predicts targets ``[*B, act]`` of inputs ``[*B, m]``, in the dtype of the inputs."""
        return torch.nn.functional.linear(inputs, self.weight.to(inputs), self.bias.to(inputs))

    def summary(self) -> dict[str, Any]:
        """Returns the entries of a run's summary: ``penalty``, ``labels_used`` and ``held_out_error``."""
        # LAPACK's last digits depend on memory addresses: keep only the digits that repeated runs reproduce
        return {
            "penalty": self.penalty,
            "labels_used": self.num_labels,
            "held_out_error": float(f"{self.error:.6g}"),
        }


@torch.no_grad()
def ridge(
    inputs: Tensor,
    targets: Tensor,
    *,
    groups: Tensor | None = None,
    penalties: Sequence[float] = PENALTIES,
    default_penalty: float | None = None,
    input_noise: float = 0.0,
    bias: bool = True,
    prior: SharedFilter | None = None,
    guessed: bool = False,
    alike: bool = True,
) -> RidgeFit:
    r"""Fits ``targets ~ D inputs + b``, in float64.

    The penalty is chosen by leave-one-out errors, :math:`e_i = (a_i - \hat a_i) / (1 - h_i)` with the leverage ``h_i``.
    With ``groups`` all rows of a group are left out together, since steps of one trajectory resemble each other. Both
    are exact. Noise of variance :math:`s^2` on every entry of future inputs acts as a penalty of :math:`n s^2` (Bishop
    1995, "Training with noise is equivalent to Tikhonov regularization"), so no smaller penalty is chosen.

    Args:
        inputs (Tensor): ``[n, m]``.
        targets (Tensor): ``[n, act]``.

    Keyword Args:
        groups (Tensor, optional): group of every row, int64 ``[n]``. Rows of a single group are left out one by one.
        penalties (sequence of float): candidates, in units of the mean square norm of the inputs.
        default_penalty (float, optional): used without any choice if there are fewer than three groups.
        input_noise (float): :math:`s^2`, in units of the mean square norm of the inputs. Defaults to 0.
        bias (bool): fit ``b``; otherwise it is 0. Defaults to ``True``.
        prior (SharedFilter, optional): the penalty shrinks ``D`` towards a filter that all targets share, fitted to
            the rows that are not left out. Defaults to 0.
        guessed (bool): the prior is used only if it lowers the held-out error. Defaults to ``False``.
        alike (bool): all targets share one penalty; otherwise each has its own. Defaults to ``True``.

    Returns:
        RidgeFit: weights, the penalty chosen and its held-out errors.

    Raises:
        ValueError: if there is no row, a value is not finite, a penalty is not positive, ``input_noise`` is
            negative, or shapes disagree.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.ridge import ridge
        >>> inputs = torch.randn(50, 4)
        >>> fit = ridge(inputs, inputs[:, :2])
        >>> fit.num_labels, fit.penalty in fit.errors, bool((fit.predict(inputs) - inputs[:, :2]).abs().max() < 1e-3)
        (50, True, True)
    """
    if inputs.ndim != 2 or targets.shape[:-1] != inputs.shape[:1]:
        raise ValueError(f"inputs must be [n, m] and targets [n, act], got {list(inputs.shape)}, {list(targets.shape)}")
    if groups is not None and groups.shape != inputs.shape[:1]:
        raise ValueError(f"groups must be [{len(inputs)}], got {list(groups.shape)}")
    if prior is not None and prior.basis.shape[1:] != (wanted := (targets.shape[-1], inputs.shape[-1])):
        raise ValueError(f"the prior's basis must be [S, {wanted[0]}, {wanted[1]}], got {list(prior.basis.shape)}")
    candidates = tuple(penalties) if default_penalty is None else (*penalties, default_penalty)
    if not candidates or not all(0 < penalty < float("inf") for penalty in candidates):
        raise ValueError(f"penalties must be positive and finite, got {candidates}")
    if not 0 <= input_noise < float("inf"):
        raise ValueError(f"input_noise must be a finite number >= 0, got {input_noise}")
    if not len(inputs):
        raise ValueError("a ridge regression needs at least one labelled step, there is none")
    x, y = inputs, targets.double()
    for name, value in (("action", y), ("input", x)):
        if not value.isfinite().all():
            raise ValueError(f"a labelled {name} is not finite")
    rows = torch.arange(len(x), device=x.device)
    groups = rows if groups is None else groups.unique(return_inverse=True)[1]
    num_groups = int(groups.max()) + 1
    if default_penalty is not None and num_groups < 3:
        penalties = (default_penalty,)
    if num_groups == 1:  # leaving out the only group would leave no rows: leave out single rows
        groups = rows
    given, mean_weight, mix = y, y.new_zeros(y.shape[-1], x.shape[-1]), None
    if prior is not None:
        filtered = torch.cat([part.double() @ prior.basis.flatten(0, 1).mT for part in x.split(ROWS)])
        mix = prior.fit(filtered.unflatten(-1, prior.basis.shape[:2]), y, groups)
        mean_weight = (mix[0, :, None, None] * prior.basis).sum(0)
        # shrinking towards the prior is shrinking towards 0 on the residuals of the prior
        y = y - torch.cat([part.double() @ mean_weight.mT for part in x.split(ROWS)])
        given = torch.cat([given, filtered], -1)

    mean_x, mean_y = (part.mean(0, dtype=torch.float64) * bias for part in (x, y))
    target = y - mean_y
    left, singular, right = thin_svd(x, mean_x)
    unit = singular.square().sum() / len(x)
    unit = torch.where(unit > 0, unit, 1.0)  # for constant inputs any positive unit works

    def lowest(squares: Tensor) -> float:  # mean square held-out error ``[P, act]`` at the best penalty or penalties
        return float(squares.mean(-1).amin() if alike else squares.amin(0).mean())

    smallest = input_noise * len(x)
    tried = sorted({max(float(penalty), smallest) for penalty in penalties})
    shrinks = torch.stack([singular.square() / (singular.square() + penalty * unit) for penalty in tried])
    projected = torch.stack([left(some).mT @ target[some] for some in rows.split(ROWS)]).sum(0)
    if mix is None:
        squares = held_out_errors(left, shrinks, projected, target, groups, centred=bias)
    else:  # residuals are linear in the target: those of each group are combined with the filter fitted without it
        parts, act = given - given.mean(0) * bias, y.shape[-1]
        along = torch.stack([left(some).mT @ parts[some] for some in rows.split(ROWS)]).sum(0)
        without = torch.cat([torch.ones_like(mix[1:, :1]), -mix[1:]], -1)
        ways = [without, torch.eye(1, without.shape[-1]).to(without).expand_as(without)]  # with and without the filter
        ways = torch.stack(ways[: 1 + guessed], 1)
        squares, *plain = held_out_errors(left, shrinks, along, parts, groups, centred=bias, mix=ways).split(act, -1)
        if guessed and lowest(plain[0]) <= lowest(squares):
            squares, projected, mean_y = plain[0], along[:, :act], given[:, :act].mean(0) * bias
            mean_weight = torch.zeros_like(mean_weight)
    errors = dict(zip(tried, squares.mean(-1).sqrt().tolist(), strict=True))
    best = squares.mean(-1).argmin()
    each = best.expand(y.shape[-1]) if alike else squares.argmin(0)
    own = singular.new_tensor(tried)[each]
    weight = right.mT @ (singular[:, None] / (singular.square()[:, None] + own * unit) * projected)  # [m, act]
    weight, offset, error = mean_weight + weight.mT, mean_y - mean_x @ weight, math.sqrt(lowest(squares))
    return RidgeFit(weight, offset, tried[int(best)], errors, error, len(x))


class SharedFilter(NamedTuple):
    r"""A prior mean for decoders with few labels: one filter ``w [S]`` that all axes share.

    .. math::
        a_{t,i} \approx \sum_s w_s v_{t,s,i} \qquad \text{for every axis } i

    with steps ``v [N, S, act]`` along each axis and actions ``[N, act]``, both in raw units. A trajectory that hardly
    moves along an axis contains little information about it; all axes together determine the few numbers ``w`` well.

    Args:
        basis (Tensor): ``[S, act, m]``, float64; the decoder of each step, in the units of inputs and targets.
        sizes (Tensor): raw size of one unit of every target ``[act]``.
    """

    basis: Tensor
    sizes: Tensor

    def fit(self, steps: Tensor, action: Tensor, groups: Tensor) -> Tensor:
        """Fits ``w`` to all rows, then to all but those of each group; returns ``[1 + G, S]``.

        Steps ``[N, S, act]`` and actions ``[N, act]`` are in the units of the targets; groups are int64 ``[N]``.
        """
        steps, action = steps * self.sizes, action * self.sizes
        own = torch.einsum("nsa,nta->nst", steps, steps), torch.einsum("nsa,na->ns", steps, action)
        count = int(groups.max()) + 1
        of_group = [part.new_zeros(count, *part.shape[1:]).index_add_(0, groups, part) for part in own]
        gram, right = (
            torch.cat([part.sum(0)[None], part.sum(0) - each]) for part, each in zip(own, of_group, strict=True)
        )
        rows = action.shape[-1] * torch.cat([groups.new_tensor([len(groups)]), len(groups) - groups.bincount()])
        unit = gram.diagonal(dim1=-2, dim2=-1).sum(-1) / rows.clamp_min(1)
        unit = torch.where(unit > 0, unit, 1.0)  # where nothing moves, w is 0
        return torch.linalg.solve(gram + SHARED_PENALTY * torch.diag_embed(unit[:, None].expand_as(right)), right)


def thin_svd(inputs: Tensor, mean: Tensor) -> tuple[Callable[[Tensor], Tensor], Tensor, Tensor]:
    """Computes the thin singular value decomposition of inputs ``[N, m]`` minus their mean ``[m]``, in float64.

    Returns a function from rows, int64 ``[n]``, to their left vectors ``[n, r]``; singular values ``[r]``, descending;
    and right vectors ``[r, m]``. With many rows, a QR decomposition reduces them in parts. With far more columns than
    rows, the Gram matrix of the rows is decomposed. Directions below rounding are left out: singular values under 1e-6
    of the largest with the Gram matrix, under 1e-9 with many rows.
    """
    rows, columns = inputs.shape
    if rows > 4 * columns:
        triangle = mean.new_zeros(0, columns)
        for part in inputs.split(max(ROWS, columns)):
            triangle = torch.linalg.qr(torch.cat([triangle, part.double() - mean]), mode="r").R
        _, singular, right = torch.linalg.svd(triangle)
        kept = singular > 1e-9 * singular[0].clamp_min(1e-300)
        singular, right = singular[kept], right[kept]
        scaled = right.mT / singular
        return lambda some: (inputs[some].double() - mean) @ scaled, singular, right
    matrix = inputs.double() - mean
    if columns > max(WIDE, 2 * rows):
        values, left = torch.linalg.eigh(matrix @ matrix.mT)
        kept = values > 1e-12 * values[-1].clamp_min(1e-300)
        singular, left = values[kept].flip(0).sqrt(), left[:, kept].flip(-1)
        right = (left.mT @ matrix) / singular[:, None]
    else:
        left, singular, right = torch.linalg.svd(matrix, full_matrices=False)
    return left.__getitem__, singular, right


def held_out_errors(
    left: Callable[[Tensor], Tensor],
    shrinks: Tensor,
    projected: Tensor,
    target: Tensor,
    groups: Tensor,
    *,
    centred: bool,
    mix: Tensor | None = None,
) -> Tensor:
    r"""Computes mean squared held-out errors ``[P, act]`` of ``P`` ridge regressions, leaving out one group at a time.

    ``U`` ``[N, r]`` are the left singular vectors (``left`` returns some rows), ``projected [r, act]`` the target's
    parts along them, and ``s`` the shrinkages of the directions, a row per regression ``[P, r]``. A ridge predicts
    :math:`\hat Y = H Y`, :math:`H = U \mathrm{diag}(s) U^T`. Rows ``G`` that are left out have exactly the errors
    :math:`(I - H_{GG})^{-1} (Y - \hat Y)_G`. If a group has more than half as many rows as there are directions, all
    regressions share :math:`U_G^T U_G` (Woodbury's identity, with :math:`V = U_G \mathrm{diag}(s)^{1/2}`):

    .. math::
        (I - V V^T)^{-1} E = E + V (I - V^T V)^{-1} V^T E

    If the mean is fitted too (``centred``), it is one more direction, without shrinkage, and already subtracted from
    the target ``[N, act]``. ``groups`` are int64 ``[N]``. With a single row and a mean, errors are infinite. With
    ``mix [G, K, S]``, the target has ``S`` parts, ``[N, S * act]``, which are summed with the weights of the group in
    ``K`` ways: errors are ``[P, K * act]``.
    """
    coefficients = shrinks.unsqueeze(-1) * projected  # [P, r, act]
    weights = target.new_ones(int(groups.max()) + 1, 1, 1) if mix is None else mix
    wide = target.shape[1] // weights.shape[2]
    if centred and len(target) == 1:
        return target.new_full((len(shrinks), weights.shape[1] * wide), torch.inf)

    def mixed(parts: Tensor, weight: Tensor) -> Tensor:
        return torch.einsum("...sa,...ks->...ka", parts.unflatten(-1, (-1, wide)), weight).flatten(-2)

    constant = len(target) ** -0.5 if centred else 0.0  # entry, in every row, of the mean's unit vector
    total = target.new_zeros(len(shrinks), weights.shape[1] * wide)
    sizes = groups.bincount()
    if int(sizes.max()) == 1:  # for single rows the leverages suffice
        for rows in torch.arange(len(target), device=target.device).split(ROWS):
            part = left(rows)
            leverage = part.square() @ shrinks.mT + constant**2
            for fit, (c, h) in enumerate(zip(coefficients, leverage.unbind(-1), strict=True)):
                total[fit] += mixed((target[rows] - part @ c) / (1 - h[:, None]), weights[groups[rows]]).square().sum(0)
        return total / len(target)
    if centred:
        shrinks = torch.cat([shrinks, shrinks.new_ones(len(shrinks), 1)], -1)
    roots = shrinks.sqrt().unsqueeze(-1)  # [P, r, 1]
    for rows, weight in zip(groups.argsort(stable=True).split(sizes.tolist()), weights, strict=True):
        part = left(rows)
        error = mixed(target[rows], weight) - part @ mixed(coefficients, weight)  # [P, |G|, act]
        if centred:
            part = torch.cat([part, part.new_full((len(part), 1), constant)], -1)
        if 2 * len(part) > part.shape[1]:
            inner = roots * (part.mT @ part) * roots.mT
            error = error + part @ (roots * _solve(inner, roots * (part.mT @ error)))
        else:
            error = _solve((part * shrinks.unsqueeze(1)) @ part.mT, error)
        total += error.square().sum(1)
    return total / len(target)


def _solve(hat: Tensor, right: Tensor) -> Tensor:
    """Solves ``(I - hat) x = right``; ``I - hat`` is symmetric and, up to rounding, positive definite."""
    keep = -hat
    keep.diagonal(dim1=-2, dim2=-1).add_(1)
    factor, info = torch.linalg.cholesky_ex(keep)
    return torch.linalg.solve(keep, right) if info.any() else torch.cholesky_solve(right, factor)
