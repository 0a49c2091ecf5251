# This source code is licensed under the MIT license found in the LICENSE file.
"""Normalisation as a module: statistics are buffers, so they travel with the weights."""

from __future__ import annotations

import torch
from torch import nn

from torchrl_koap.lookup import lookup


def _minmax(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = values.amin(0), values.amax(0)
    return (high + low) / 2, (high - low) / 2


def _standard(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return values.mean(0), values.std(0, correction=0)


def _shared(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return values.mean(0), values.std(0, correction=0).amax().expand(values.shape[-1]).clone()


def _rms(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros_like(values[0]), values.square().mean(0).sqrt()


def _identity(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros_like(values[0]), torch.ones_like(values[0])


MODES = {"minmax": _minmax, "standard": _standard, "shared": _shared, "rms": _rms, "identity": _identity}


class Normalizer(nn.Module):
    r"""Shifts and scales each column: :math:`y = (x - \text{offset}) / \text{scale}`.

    Made by :meth:`fit`. Without arguments it has no statistics: calling it is an error until a state dict with
    statistics is loaded.

    Args:
        offset (Tensor, optional): ``[d]``.
        scale (Tensor, optional): ``[d]``, positive.

    Shape:
        every method takes and gives ``[*B, d]``, in the floating type of its argument.

    Raises:
        ValueError: if offset and scale do not fit each other, are not finite, or a scale is not positive.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import Normalizer
        >>> normalizer = Normalizer.fit(torch.tensor([[0.0, 5.0], [4.0, 5.0]]))
        >>> normalizer(torch.tensor([[1.0, 5.0]]))
        tensor([[-0.5000,  0.0000]])
        >>> normalizer.inverse(torch.tensor([[-0.5, 0.0]]))
        tensor([[1., 5.]])
        >>> restored = Normalizer()
        >>> _ = restored.load_state_dict(normalizer.state_dict())
        >>> restored.scale
        tensor([2., 1.])
    """

    offset: torch.Tensor | None
    scale: torch.Tensor | None

    def __init__(self, offset: torch.Tensor | None = None, scale: torch.Tensor | None = None):
        super().__init__()
        if (offset is None) != (scale is None):
            raise ValueError("a normalizer needs both offset and scale, or neither")
        if offset is not None:
            if offset.ndim != 1 or offset.shape != scale.shape:
                raise ValueError(f"offset and scale must be [d], got {list(offset.shape)} and {list(scale.shape)}")
            if not offset.is_meta and not (offset.isfinite().all() and scale.isfinite().all() and (scale > 0).all()):
                raise ValueError("offset must be finite, scale finite and positive")
            offset, scale = offset.detach().clone(), scale.detach().clone()
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)

    @classmethod
    def fit(cls, values: torch.Tensor, *, mode: str = "minmax", mask: torch.Tensor | None = None) -> Normalizer:
        """Takes the statistics of a data set.

        Args:
            values (Tensor): ``[*N, d]``.
            mode (str): ``"minmax"`` maps the range of each column to [-1, 1], ``"standard"`` its mean and standard
                deviation to 0 and 1, ``"rms"`` its root mean square to 1 and 0 to 0, ``"identity"`` changes nothing.
                A column whose scale would be zero, up to rounding, keeps the scale 1.
            mask (Tensor, optional): ``[*N]`` or ``[*N, 1]`` bool, rows to use; the others may hold NaN. For actions
                this is ``has_action``.

        Returns:
            Normalizer: with buffers of the floating type of ``values``.

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
            raise ValueError("there are no rows to take statistics of")
        bad = ~rows.isfinite()
        if bad.any():
            columns = bad.any(0).nonzero().flatten().tolist()
            count = int(bad.any(-1).sum())
            raise ValueError(f"{count} of {len(rows)} rows are NaN or infinite, in columns {columns}")

        rows = rows.double()
        offset, scale = statistics(rows)
        rounding = 4 * torch.finfo(values.dtype).eps * rows.abs().amax(0)
        scale = torch.where(scale <= rounding, 1.0, scale)
        scale = torch.where(scale.to(values.dtype) > 0, scale, 1.0)  # too small for the type of the values
        return cls(offset.to(values.dtype), scale.to(values.dtype))

    @property
    def is_fitted(self) -> bool:
        """Whether there are statistics."""
        return self.offset is not None

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """Normalises values ``[*B, d]``."""
        offset, scale = self._statistics(values)
        return (values - offset) / scale

    def inverse(self, values: torch.Tensor) -> torch.Tensor:
        """Turns normalised values ``[*B, d]`` back."""
        offset, scale = self._statistics(values)
        return values * scale + offset

    def extra_repr(self) -> str:
        """Size for printing."""
        return f"{self.offset.shape[0]} columns" if self.is_fitted else "no statistics"

    def _statistics(self, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if self.offset is None or self.scale is None:
            raise RuntimeError("this normalizer has no statistics: use Normalizer.fit, or load a state dict with them")
        if values.shape[-1:] != self.offset.shape:
            raise ValueError(f"wanted {self.offset.shape[0]} columns, got shape {list(values.shape)}")
        return self.offset.to(values.dtype), self.scale.to(values.dtype)

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, strict, missing_keys, *args):
        # buffers that are None are unknown to nn.Module: make room for the statistics, or report that they are missing
        for name in ("offset", "scale"):
            saved = state_dict.get(prefix + name)
            if getattr(self, name) is None:
                if saved is None:
                    if strict:
                        missing_keys.append(prefix + name)
                else:
                    setattr(self, name, torch.empty_like(saved, device=torch.get_default_device()))
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, missing_keys, *args)
