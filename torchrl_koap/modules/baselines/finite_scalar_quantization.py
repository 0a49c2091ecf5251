# This source code is licensed under the MIT license found in the LICENSE file.
"""Finite scalar quantisation: a discrete code by rounding a few bounded numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn


class FiniteScalarQuantizer(nn.Module):
    r"""Bounds every entry of a code and rounds it to one of a few levels; gradients pass straight through.

    .. math::
        c_i = \frac{1}{\lfloor L_i / 2 \rfloor}
            \operatorname{round}(\tfrac{L_i - 1}{2} \tanh(z_i + s_i) - o_i),
        \qquad o_i = \tfrac12 [L_i \text{ even}], \quad \tfrac{L_i - 1}{2} \tanh(s_i) = o_i

    after Mentzer et al. 2023 (arXiv 2309.15505). An even number of levels has no middle one: they lie half a level
    lower, and the shift ``s`` keeps 0 at the code 0. There is no codebook to train and no term for it in a loss; a
    codebook is the ``prod(levels)`` codes there are. Several of them stand side by side.

    Args:
        features (int): size ``m`` of what is quantised; a linear map takes it to the entries of the codes, and a second
            one the codes back to ``m``.

    Keyword Args:
        levels (sequence of int): levels of every entry, 3 or more. Defaults to ``(8, 5, 5, 5)``, 1000 codes.
        num_codebooks (int): number ``C`` of codes side by side. Defaults to ``2``.

    Shape:
        ``forward``: ``[*B, m] -> [*B, m]``; codes are ``[*B, C * len(levels)]``, indices int64 ``[*B, C]``.

    Raises:
        ValueError: for fewer than 3 levels or no codebook.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import FiniteScalarQuantizer
        >>> quantizer = FiniteScalarQuantizer(16)
        >>> quantizer(torch.randn(5, 7, 16)).shape
        torch.Size([5, 7, 16])
        >>> codes = quantizer.indices_to_codes(torch.tensor([[0, 999]]))
        >>> codes.tolist()
        [[-1.0, -1.0, -1.0, -1.0, 0.75, 1.0, 1.0, 1.0]]
        >>> quantizer.codes_to_indices(codes)
        tensor([[  0, 999]])
    """

    levels: Tensor
    basis: Tensor

    def __init__(self, features: int, *, levels: Sequence[int] = (8, 5, 5, 5), num_codebooks: int = 2):
        super().__init__()
        if not levels or min(levels) < 3:
            raise ValueError(f"every entry of a code needs 3 levels or more, got levels {tuple(levels)}")
        if num_codebooks < 1:
            raise ValueError(f"num_codebooks must be >= 1, got {num_codebooks}")
        self.num_codebooks, self.num_codes = num_codebooks, math.prod(levels)
        self._sizes = {
            "levels": tuple(levels) * num_codebooks,
            "basis": tuple(math.prod(levels[:place]) for place in range(len(levels))),
        }
        for name, sizes in self._sizes.items():
            self.register_buffer(name, torch.tensor(sizes), persistent=False)
        self.project_in = nn.Linear(features, len(self.levels))
        self.project_out = nn.Linear(len(self.levels), features)

    def bound(self, values: Tensor) -> Tensor:
        """Values ``[*B, C * len(levels)]`` squashed to the range of the levels, which are the whole numbers in it."""
        levels = self.levels.to(values.dtype)
        half_range, offset = (levels - 1) / 2, (levels % 2 == 0).to(values.dtype) / 2
        return half_range * (values + (offset / half_range).atanh()).tanh() - offset

    def quantize(self, values: Tensor) -> Tensor:
        """Codes ``[*B, C * len(levels)]``, every entry in [-1, 1]; the gradient is that of :meth:`bound`."""
        bounded = self.bound(values)
        return (bounded + (bounded.round() - bounded).detach()) / (self.levels // 2)

    def encode(self, features: Tensor) -> Tensor:
        """Codes ``[*B, C * len(levels)]`` of features ``[*B, m]``."""
        return self.quantize(self.project_in(features))

    def codes_to_indices(self, codes: Tensor) -> Tensor:
        """Number of the code in each codebook, int64 ``[*B, C]`` in ``0 .. prod(levels) - 1``."""
        half = self.levels // 2
        digits = (codes * half).round().long() + half
        return (digits.unflatten(-1, (self.num_codebooks, -1)) * self.basis).sum(-1)

    def indices_to_codes(self, indices: Tensor) -> Tensor:
        """Codes ``[*B, C * len(levels)]`` of their numbers ``[*B, C]``, in the floating type of the weights.

        Raises:
            ValueError: for another number of codebooks.
        """
        if indices.shape[-1] != self.num_codebooks:
            raise ValueError(f"indices must be [*B, {self.num_codebooks}], got {list(indices.shape)}")
        levels = self.levels.unflatten(-1, (self.num_codebooks, -1))
        digits = (indices.unsqueeze(-1) // self.basis % levels).flatten(-2)
        half = self.levels // 2
        return (digits - half).to(self.project_in.weight.dtype) / half

    def forward(self, features: Tensor) -> Tensor:
        """Features ``[*B, m]`` by way of their code."""
        return self.project_out(self.encode(features))

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # what is not in the file has no numbers yet where the module was built under torch.device("meta")
        device = self.project_in.weight.device
        if device.type == "meta" and f"{prefix}project_in.weight" in state_dict:
            device = state_dict[f"{prefix}project_in.weight"].device
        for name, sizes in self._sizes.items():
            setattr(self, name, torch.tensor(sizes, device=device))
        super()._load_from_state_dict(state_dict, prefix, *args)
