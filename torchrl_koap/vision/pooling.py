# This source code is licensed under the MIT license found in the LICENSE file.
"""From feature maps to a vector: averages forget where things are, expected places and a coarse grid keep it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

GRID = 6  # places of the coarse grid, both ways


def average(maps: Tensor) -> Tensor:
    """Mean of every channel over all places: ``[B, C, h, w]`` to ``[B, C]``."""
    return maps.mean((-2, -1))


def spatial_softmax(maps: Tensor, temperature: float = 1.0) -> Tensor:
    """Expected place of every channel under the softmax of its map.

    Args:
        maps (Tensor): ``[B, C, h, w]``.
        temperature (float): of the softmax, in standard deviations of the map.

    Returns:
        Tensor: ``[B, 2 C]``: x of all channels, then y, from -1 to 1.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision.pooling import spatial_softmax
        >>> maps = torch.zeros(1, 1, 5, 5)
        >>> maps[0, 0, 1, 4] = 100.0
        >>> bool((spatial_softmax(maps) - torch.tensor([[1.0, -0.5]])).abs().max() < 0.2)
        True
    """
    flat = maps.flatten(-2)
    scale = flat.std(-1, keepdim=True).clamp_min(1e-6) * temperature
    weights = (flat / scale).softmax(-1).unflatten(-1, maps.shape[-2:])
    x, y = (torch.linspace(-1, 1, size, dtype=maps.dtype, device=maps.device) for size in maps.shape[:-3:-1])
    return torch.cat([(weights.sum(-2) * x).sum(-1), (weights.sum(-1) * y).sum(-1)], -1)


def grid(maps: Tensor) -> Tensor:
    """Mean of every channel in each field of a coarse grid: ``[B, C, h, w]`` to ``[B, C GRID GRID]``."""
    return F.adaptive_avg_pool2d(maps, GRID).flatten(1)


def places(maps: Tensor) -> Tensor:
    """All of the map as it is: ``[B, C, h, w]`` to ``[B, C h w]``."""
    return maps.flatten(1)


POOLINGS: dict[str, Callable[[Tensor], Tensor]] = {
    "average": average,
    "spatial_softmax": spatial_softmax,
    "grid": grid,
    "places": places,
}


class Projection(nn.Module):
    """Principal components of pooled features, fitted on frames without labels.

    Args:
        mean (Tensor): ``[F]``.
        components (Tensor): ``[F, d]``; scaled so that the first component has variance 1.

    Raises:
        ValueError: if mean and components have other shapes.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision import Projection
        >>> features = torch.randn(200, 10, generator=torch.Generator().manual_seed(0)) * torch.arange(1.0, 11.0)
        >>> projected = Projection.fit(features, 3)(features)
        >>> projected.shape, round(projected[:, 0].std().item(), 3), bool(projected.mean(0).abs().max() < 1e-4)
        (torch.Size([200, 3]), 1.0, True)
    """

    def __init__(self, mean: Tensor, components: Tensor):
        super().__init__()
        if mean.ndim != 1 or components.ndim != 2 or len(mean) != len(components):
            raise ValueError(
                f"mean must be [F] and components [F, d], got {list(mean.shape)} and {list(components.shape)}"
            )
        self.register_buffer("mean", mean)
        self.register_buffer("components", components)

    @classmethod
    def fit(cls, features: Tensor, dim: int) -> Projection:
        """Fits the components.

        Args:
            features (Tensor): ``[N, F]``.
            dim (int): number of components.

        Raises:
            ValueError: if there are fewer frames or features than components.
        """
        if min(features.shape) <= dim:
            raise ValueError(f"{dim} components need more frames and features than that, got {list(features.shape)}")
        features = features.double()
        mean = features.mean(0)
        centred = features - mean
        if len(centred) < centred.shape[1]:  # the small one of the two products
            values, left = torch.linalg.eigh(centred @ centred.T)
            values, left = values.flip(0)[:dim].clamp_min(1e-12), left.flip(1)[:, :dim]
            axes = centred.T @ left / values.sqrt()
        else:
            values, axes = torch.linalg.eigh(centred.T @ centred)
            values, axes = values.flip(0)[:dim], axes.flip(1)[:, :dim]
        signs = axes.gather(0, axes.abs().argmax(0, keepdim=True)).sign()  # the same on every machine
        scale = (values[0] / (len(features) - 1)).sqrt()
        return cls(mean.float(), (axes * signs / scale).float())

    @property
    def dim(self) -> int:
        """Number of components."""
        return self.components.shape[1]

    def forward(self, features: Tensor) -> Tensor:
        """Components ``[*B, d]`` of features ``[*B, F]``.

        Raises:
            ValueError: if the features are of another size.
        """
        if features.shape[-1] != len(self.mean):
            raise ValueError(
                f"the projection was fitted on {len(self.mean)} features, got {features.shape[-1]}: another network,"
                " stage, pooling or size of the frames"
            )
        return (features - self.mean) @ self.components

    def save(self, path: str | Path, about: dict[str, str]) -> Path:
        """Writes it as safetensors.

        Args:
            path (str or Path): file to write.
            about (dict): what the file says of itself, text by name.
        """
        from safetensors.torch import save_file

        save_file({"mean": self.mean.contiguous(), "components": self.components.half().contiguous()}, path, about)
        return Path(path)

    @classmethod
    def load(cls, path: str | Path) -> tuple[Projection, dict[str, str]]:
        """Reads what :meth:`save` wrote.

        Returns:
            tuple: the projection and its description.

        Raises:
            FileNotFoundError: if there is no such file.
        """
        from safetensors import safe_open

        if not Path(path).is_file():
            raise FileNotFoundError(f"no projection: there is no file {path}")
        with safe_open(str(path), "pt") as file:
            tensors = {name: file.get_tensor(name).float() for name in ("mean", "components")}
            return cls(tensors["mean"], tensors["components"]), dict(file.metadata() or {})
