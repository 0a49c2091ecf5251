# This source code is licensed under the MIT license found in the LICENSE file.
"""Principal components of pooled features, and encoders whose components lie in a file."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from torchrl_koap.vision.backbones import WeightsError, load_backbone
from torchrl_koap.vision.encoder import FrozenImageEncoder

SCOOPING = Path(__file__).with_name("scooping.safetensors")


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
        """Fits ``dim`` components to features ``[N, F]``.

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
        """Computes components ``[*B, d]`` of features ``[*B, F]``.

        Raises:
            ValueError: if the features are of another size.
        """
        if features.shape[-1] != len(self.mean):
            raise ValueError(
                f"the projection was fitted on {len(self.mean)} features, got {features.shape[-1]}: another network,"
                " stage or size of the frames"
            )
        return (features - self.mean) @ self.components


def projection_of(task: str) -> Path:
    """Returns the file of a task's projection that comes with the package.

    Returns:
        Path: the file.

    Raises:
        ValueError: if none was fitted for the task.

    Examples:
        >>> from torchrl_koap.vision import projection_of
        >>> projection_of("scooping").name
        'scooping.safetensors'
    """
    path = SCOOPING.with_stem(task)
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in SCOOPING.parent.glob("*.safetensors")))
        raise ValueError(f"no projection comes with the package for task {task!r} (only for {known}): pass your own")
    return path


def save_encoder(encoder: FrozenImageEncoder, path: str | Path, *, stride: int, fitted_on: str) -> Path:
    """Writes an encoder's projection and what it belongs to; the network's weights stay where they are.

    Args:
        encoder (FrozenImageEncoder): with a :class:`Projection`.
        path (str or Path): file to write.
        stride (int): of the network's stage.
        fitted_on (str): which frames it was fitted on, in words.

    Returns:
        Path: the file.

    Raises:
        ValueError: if the encoder has no projection.

    Examples:
        >>> from torchrl_koap.vision import load_encoder, save_encoder
        >>> save_encoder(load_encoder(), "own.safetensors", stride=8, fitted_on="my frames")  # doctest: +SKIP
    """
    if encoder.projection is None:
        raise ValueError("the encoder has no projection: there is nothing to save")
    projection = encoder.projection
    tensors = {"mean": projection.mean.contiguous(), "components": projection.components.half().contiguous()}
    save_file(tensors, path, encoder.identity | {"stride": str(stride), "fitted_on": fitted_on})
    return Path(path)


def load_encoder(projection: str | Path = SCOOPING, network: str | Path | None = None) -> FrozenImageEncoder:
    """Loads an encoder from a file that :func:`save_encoder` wrote.

    Args:
        projection (str or Path): the file. Default: the one of Scooping that comes with the package.
        network (str or Path, optional): see :func:`~torchrl_koap.vision.load_backbone`.

    Returns:
        FrozenImageEncoder: frozen, in evaluation mode.

    Raises:
        WeightsError: if there are no weights, or others than those the projection was fitted behind.
        FileNotFoundError: if there is no such file.

    Examples:
        >>> from torchrl_koap.vision import load_encoder
        >>> load_encoder("nowhere.safetensors")
        Traceback (most recent call last):
        ...
        FileNotFoundError: no projection: there is no file nowhere.safetensors
    """
    if not Path(projection).is_file():
        raise FileNotFoundError(f"no projection: there is no file {projection}")
    with safe_open(str(projection), "pt") as file:
        mean, components = (file.get_tensor(name).float() for name in ("mean", "components"))
        about = dict(file.metadata() or {})
    fitted, backbone = Projection(mean, components), load_backbone(network, stride=int(about["stride"]))
    if backbone.digest != about["weights"]:
        raise WeightsError(
            f"the projection was fitted behind the weights {about['weights'][:12]} of {about['network']}, these are"
            f" {backbone.digest[:12]} of {backbone.name}: fit one for them, or pass the network it belongs to"
        )
    return FrozenImageEncoder(backbone, projection=fitted, size=int(about["size"]))
