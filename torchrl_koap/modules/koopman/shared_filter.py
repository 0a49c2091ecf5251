# This source code is licensed under the MIT license found in the LICENSE file.
"""What a decoder believes before it has seen many labels: every axis of the robot answers alike."""

from __future__ import annotations

import torch
from torch import Tensor


def fit_shared_filter(steps: Tensor, action: Tensor, *, penalty: float = 0.02) -> Tensor:
    r"""Fits one filter for all axes.

    .. math::
        a_{t,i} \approx \sum_s w_s v_{t,s,i} \qquad \text{for every axis } i

    with a ridge penalty relative to the mean square of the steps. A trajectory that hardly moves along one axis says
    little about that axis; together they determine the few numbers ``w`` well. A full decoder is then fitted around
    this one (``prior`` of :meth:`~torchrl_koap.modules.LinearActionDecoder.fit_ridge`).

    Args:
        steps (Tensor): steps ``v`` of each axis' own coordinate, ``[N, S, act]``, raw units.
        action (Tensor): actions ``[N, act]``, raw units.

    Keyword Args:
        penalty (float): assumed ratio of noise to signal variance. Defaults to ``0.02``.

    Returns:
        Tensor: the filter ``w`` ``[S]``.

    Raises:
        ValueError: if the axes of steps and actions differ.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.koopman.shared_filter import fit_shared_filter
        >>> steps, true = torch.randn(500, 3, 2), torch.tensor([0.5, -1.0, 2.0])
        >>> found = fit_shared_filter(steps, torch.einsum("nsa,s->na", steps, true))
        >>> bool((found - true).abs().max() < 0.01)
        True
    """
    if steps.ndim != 3 or action.shape != (steps.shape[0], steps.shape[2]):
        raise ValueError(
            f"steps must be [N, S, act] and action [N, act], got {list(steps.shape)} and {list(action.shape)}"
        )
    rows, target = steps.mT.flatten(0, 1), action.flatten()  # [N * act, S]
    unit = rows.square().sum(-1).mean()
    gram = rows.mT @ rows + penalty * unit * torch.eye(rows.shape[-1], dtype=rows.dtype, device=rows.device)
    return torch.linalg.solve(gram, rows.mT @ target)
