# This source code is licensed under the MIT license found in the LICENSE file.
"""Gradients far longer than those before them, by which a long training can undo itself within a few updates.

Where gradients have become short, so has the second moment that AdamW divides by. One that is several times as long
then moves every parameter by several learning rates, the next one is longer still, and within twenty updates the loss
is what it was at the beginning. Such jumps are known from large models (Wortsman et al. 2023, which limits the update
by the same comparison, tensor by tensor). Here the length of the whole gradient is compared, so that a training without
outliers is not touched.
"""

from __future__ import annotations

import torch
from torch import Tensor

TIMES = 5.0  # lengths of mini-batch gradients vary by a factor of two or so about their mean square
SETTLED = 100  # updates before which the second moment says little


@torch.no_grad()
def limit_outlier(optimizer: torch.optim.AdamW, *, times: float = TIMES) -> Tensor | None:
    """Shortens the gradient to ``times`` the root mean square length of earlier ones, where it is longer.

    Call it between ``backward`` and ``step``. What is typical is read off the optimizer's second moment, so that a
    training that is resumed goes on the same.

    Args:
        optimizer (torch.optim.AdamW): whose parameters hold the gradient.

    Keyword Args:
        times (float): how much longer than typical a gradient may be.

    Returns:
        Tensor: the factor ``[]`` that the gradient was multiplied by, 1 for any ordinary one; None while the optimizer
        has seen too few.

    Examples:
        >>> import torch
        >>> from torchrl_koap.training.outlier_gradients import limit_outlier
        >>> x = torch.nn.Parameter(torch.zeros(2))
        >>> optimizer = torch.optim.AdamW([x], lr=1e-3)
        >>> for _ in range(200):
        ...     x.grad = torch.tensor([0.6, 0.8])
        ...     _ = limit_outlier(optimizer)
        ...     optimizer.step()
        >>> x.grad = torch.tensor([0.0, 1000.0])
        >>> round(limit_outlier(optimizer).item(), 4), round(x.grad.norm().item(), 2)
        (0.005, 5.0)
    """
    group = optimizer.param_groups[0]
    parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
    states = [optimizer.state[parameter] for parameter in parameters if "step" in optimizer.state[parameter]]
    if len(states) < len(parameters) or not states:
        return None
    updates = float(states[0]["step"])
    if updates < SETTLED:
        return None
    gradients = [parameter.grad for parameter in parameters]
    length = torch.nn.utils.get_total_norm(gradients)
    # the second moment is positive: its sum is the 1-norm
    moment = torch.stack(torch._foreach_norm([state["exp_avg_sq"] for state in states], 1)).sum()
    typical = (moment / (1 - group["betas"][1] ** updates)).sqrt()
    factor = (times * typical / length).clamp(max=1.0).nan_to_num(1.0)  # a gradient of zero, or one that is not finite
    torch._foreach_mul_(gradients, factor)
    return factor
