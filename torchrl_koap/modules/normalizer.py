# This source code is licensed under the MIT license found in the LICENSE file.
"""Normalisation as a module, whose statistics are buffers and so part of the state dict."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_koap.lookup import lookup


def _minmax(values: Tensor) -> tuple[Tensor, Tensor]:
    low, high = values.amin(0), values.amax(0)
    return (high + low) / 2, (high - low) / 2


def _standard(values: Tensor) -> tuple[Tensor, Tensor]:
    return values.mean(0), values.std(0, correction=0)


def _moving(values: Tensor) -> tuple[Tensor, Tensor]:
    rest = values[:: -(-len(values) // 10_000)].median(0).values  # the median of all takes seconds
    apart = (values - rest).abs()
    moving = apart > 0.01 * apart.amax(0)
    return rest, (apart.square() * moving).sum(0).div(moving.sum(0).clamp(min=1)).sqrt()


_COLUMNS = 32  # columns whose statistics are computed at once
# functions that return offset and scale of each column; with "shared" all columns then use the largest scale
MODES = {
    "minmax": _minmax,
    "standard": _standard,
    "shared": _standard,
    "rms": lambda x: (torch.zeros_like(x[0]), x.square().mean(0).sqrt()),
    "moving": _moving,
}


class Normalizer(nn.Module):
    r"""Shifts and scales each column: :math:`y = (x - \text{offset}) / \text{scale}`.

    It is the identity until it has statistics: from :meth:`fit`, the keywords, or a state dict.

    Args:
        width (int): number of columns ``d``.

    Keyword Args:
        offset (Tensor, optional): ``[d]``. Defaults to 0.
        scale (Tensor, optional): ``[d]``, positive. Defaults to 1.

    Shape:
        every method maps ``[*B, d]`` to ``[*B, d]`` in the dtype of its argument.

    Raises:
        ValueError: if offset and scale are not ``[d]``, not finite, or a scale is not positive; at a call for another
            number of columns, or whole numbers.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import Normalizer
        >>> normalizer = Normalizer.fit(torch.tensor([[0.0, 5.0], [4.0, 5.0]]))
        >>> normalizer(torch.tensor([[1.0, 5.0]]))
        tensor([[-0.5000,  0.0000]])
        >>> normalizer.inverse(torch.tensor([[-0.5, 0.0]]))
        tensor([[1., 5.]])
    """

    offset: Tensor
    scale: Tensor

    def __init__(self, width: int, *, offset: Tensor | None = None, scale: Tensor | None = None):
        super().__init__()
        offset = torch.zeros(width) if offset is None else offset.detach().clone()
        scale = torch.ones(width) if scale is None else scale.detach().clone()
        if offset.shape != (width,) or scale.shape != (width,):
            raise ValueError(f"offset and scale must be [{width}], got {list(offset.shape)} and {list(scale.shape)}")
        if not offset.is_meta and not (offset.isfinite().all() and scale.isfinite().all() and (scale > 0).all()):
            raise ValueError("offset must be finite, scale finite and positive")
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)

    @classmethod
    def fit(cls, values: Tensor, *, mode: str = "minmax", mask: Tensor | None = None) -> Normalizer:
        """Makes a normaliser with the statistics of a data set.

        Args:
            values (Tensor): ``[*N, d]``.
            mode (str): ``"minmax"`` maps the range of each column to [-1, 1]. ``"standard"`` maps its mean to 0 and its
                standard deviation to 1. ``"shared"`` does the same with the largest standard deviation of all columns.
                ``"rms"`` maps its root mean square to 1 and keeps 0. ``"moving"`` maps its median to 0, and to 1 the
                root mean square distance from the median, over rows with more than 1 % of the largest distance: a
                column that rarely moves is scaled by the size of its motions. A scale that is zero, up to rounding,
                becomes 1.
            mask (Tensor, optional): ``[*N]`` or ``[*N, 1]`` bool, rows to use; the others may hold NaN. For actions
                this is ``has_action``.

        Returns:
            Normalizer: with buffers of the dtype of ``values``.

        Raises:
            ValueError: if the mode is unknown, the mask does not fit or selects nothing, or a used row is not finite.
        """
        statistics = lookup(MODES, mode, "normalisation")
        if values.ndim < 2 or not values.is_floating_point():
            raise ValueError(f"values must be a float tensor [*N, d], got {values.dtype} {list(values.shape)}")
        rows = values.detach().flatten(0, -2)
        if mask is not None:
            shapes = (values.shape[:-1], (*values.shape[:-1], 1))
            if mask.dtype != torch.bool or mask.shape not in shapes:
                wanted = f"bool {list(shapes[0])} or {list(shapes[1])}"
                raise ValueError(f"mask must be {wanted}, got {mask.dtype} {list(mask.shape)}")
            rows = rows[mask.flatten()]
        if not len(rows):
            raise ValueError("values has no rows to compute statistics from")
        bad = ~rows.isfinite()
        if bad.any():
            columns = bad.any(0).nonzero().flatten().tolist()
            count = int(bad.any(-1).sum())
            raise ValueError(f"{count} of {len(rows)} rows are NaN or infinite, in columns {columns}")

        # float64, for some columns at a time: all columns together may take gigabytes
        parts = [(*statistics(part), part.abs().amax(0)) for part in map(Tensor.double, rows.split(_COLUMNS, -1))]
        offset, scale, largest = map(torch.cat, zip(*parts, strict=True))
        if mode == "shared":
            scale = scale.amax().expand_as(scale)
        rounding = 4 * torch.finfo(values.dtype).eps * largest
        scale = torch.where(scale <= rounding, 1.0, scale)
        scale = torch.where(scale.to(values.dtype) > 0, scale, 1.0)  # the dtype may round small scales to 0
        return cls(rows.shape[-1], offset=offset.to(values.dtype), scale=scale.to(values.dtype))

    def forward(self, values: Tensor) -> Tensor:
        """Normalises values ``[*B, d]``."""
        offset, scale = self._statistics(values)
        return (values - offset) / scale

    def inverse(self, values: Tensor) -> Tensor:
        """Maps normalised values ``[*B, d]`` to the original units."""
        offset, scale = self._statistics(values)
        return values * scale + offset

    def _statistics(self, values: Tensor) -> tuple[Tensor, Tensor]:
        if values.shape[-1:] != self.offset.shape:
            raise ValueError(f"wanted {len(self.offset)} columns, got shape {list(values.shape)}")
        if not values.is_floating_point():  # their dtype would round offset and scale
            raise ValueError(f"wanted floating-point numbers, got {values.dtype}; cast them, as with .float()")
        return self.offset.to(values.dtype), self.scale.to(values.dtype)
