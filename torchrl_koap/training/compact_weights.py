# This source code is licensed under the MIT license found in the LICENSE file.
"""Weights in a quarter of their size: every row of a matrix as bytes and one scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

ROW_SCALE = ".row_scale"
_LEAST = 4096  # entries of a tensor that is worth it


def compact(tensors: Mapping[str, Tensor], *, only: Sequence[str] = ()) -> dict[str, Tensor]:
    """Stores weight matrices as ``int8`` and a scale per row; biases, statistics and whatever else stay as they are.

    Args:
        tensors (mapping): a state dict; entries with two or more axes and at least 4,096 floats are matrices.
        only (sequence of str): ends of the names that are compacted. Default: all matrices.

    Returns:
        dict: for a matrix ``name`` the entries ``name`` (int8) and ``name.row_scale`` (float32 ``[rows, 1, ...]``).

    Examples:
        >>> import torch
        >>> from torchrl_koap.training.compact_weights import compact, expand
        >>> weights = {"layer.weight": torch.randn(64, 64), "layer.bias": torch.randn(64)}
        >>> small = compact(weights)
        >>> {name: str(tensor.dtype) for name, tensor in small.items()}
        {'layer.weight': 'torch.int8', 'layer.weight.row_scale': 'torch.float32', 'layer.bias': 'torch.float32'}
        >>> (expand(small)["layer.weight"] - weights["layer.weight"]).abs().max().item() < 0.02
        True
    """
    small = {}
    for name, tensor in tensors.items():
        spared = only and not name.endswith(tuple(only))
        if spared or tensor.ndim < 2 or tensor.numel() < _LEAST or not tensor.is_floating_point():
            small[name] = tensor
            continue
        scale = tensor.flatten(1).abs().amax(1).clamp_min(1e-12).div(127).reshape(-1, *[1] * (tensor.ndim - 1))
        small[name] = (tensor / scale).round().to(torch.int8)
        small[name + ROW_SCALE] = scale.float()
    return small


def expand(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Inverse of :func:`compact`, up to rounding; a state dict without scales comes back as it is."""
    return {
        name: tensor.float() * tensors[name + ROW_SCALE] if name + ROW_SCALE in tensors else tensor
        for name, tensor in tensors.items()
        if not (name.endswith(ROW_SCALE) and name.removesuffix(ROW_SCALE) in tensors)
    }
