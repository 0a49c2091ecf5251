# This source code is licensed under the MIT license found in the LICENSE file.
"""A pretrained network that stays as it is, as a TorchRL transform: frames in, embeddings out."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_koap.lookup import lookup
from torchrl_koap.vision.backbones import Backbone, load_backbone
from torchrl_koap.vision.cache import EmbeddingCache
from torchrl_koap.vision.pooling import POOLINGS, Projection

BATCH = 64  # frames that go through the network at once


class FrozenImageEncoder(ObservationTransform):
    """Embeds camera frames with a frozen network: preprocessing as torchvision's, pooling, principal components.

    Args:
        backbone (Backbone, optional): see :func:`~torchrl_koap.vision.load_backbone`. Default: EfficientNet-Lite0.

    Keyword Args:
        pooling (str): ``"average"``, ``"spatial_softmax"``, ``"grid"`` or ``"places"``.
        projection (Projection, optional): of the pooled features. Default: none, the features are the embedding.
        size (int): height and width that frames must have.
        in_key (str): entry with the frames, uint8 ``[*B, size, size, 3]``.
        out_key (str): entry of the embeddings, float32 ``[*B, d]``.
        cache (str or Path, optional): folder in which :meth:`features` keeps what went through the network.

    Raises:
        WeightsError: if there are no weights.
        ValueError: for an unknown pooling; in use, for frames of another size or dtype.
        CacheError: if the cache is of other weights.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.vision import FrozenImageEncoder
        >>> from torchrl_koap.vision.backbones import Backbone
        >>> from torchrl_koap.vision.resnet import ResNet
        >>> torch.manual_seed(0)  # doctest: +ELLIPSIS
        <torch...
        >>> encoder = FrozenImageEncoder(Backbone(ResNet("resnet18").up_to(8), "random", "resnet18"))
        >>> encoder(TensorDict({"pixels": torch.zeros(2, 96, 96, 3, dtype=torch.uint8)}, [2]))["embedding"].shape
        torch.Size([2, 256])
    """

    def __init__(
        self,
        backbone: Backbone | None = None,
        *,
        pooling: str = "spatial_softmax",
        projection: Projection | None = None,
        size: int = 96,
        in_key: str = "pixels",
        out_key: str = "embedding",
        cache: str | Path | None = None,
    ):
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        lookup(POOLINGS, pooling, "pooling")
        self.backbone = load_backbone() if backbone is None else backbone
        self.pooling, self.projection, self.size = pooling, projection, size
        self.cache = None if cache is None else EmbeddingCache(cache, self.identity)

    @property
    def identity(self) -> dict[str, str]:
        """What pooled features depend on."""
        places = [*self.backbone(torch.zeros(1, 3, self.size, self.size)).shape[-2:]]
        return {
            "weights": self.backbone.digest,
            "network": self.backbone.name,
            "places": "x".join(map(str, places)),
            "pooling": self.pooling,
            "size": str(self.size),
        }

    def check(self, frames: Tensor) -> None:
        """Refuses what is no batch of frames.

        Raises:
            ValueError: for another dtype, layout or size.
        """
        if frames.dtype != torch.uint8:
            raise ValueError(f"frames must be uint8 in 0 to 255, got {frames.dtype}")
        wanted = (self.size, self.size, 3)
        if frames.ndim < 3 or tuple(frames.shape[-3:]) != wanted:
            raise ValueError(f"frames must be [*B, {self.size}, {self.size}, 3], got shape {list(frames.shape)}")

    @torch.no_grad()
    def features(self, frames: Tensor) -> Tensor:
        """Pooled features ``[*B, F]`` of frames ``[*B, H, W, 3]``, from the cache where they are there.

        Raises:
            ValueError: for frames of another dtype or size.
        """
        self.check(frames)
        batch, flat = frames.shape[:-3], frames.reshape(-1, *frames.shape[-3:])
        found = None if self.cache is None else self.cache.get(flat)
        if found is None:
            pool, pictures = POOLINGS[self.pooling], flat.permute(0, 3, 1, 2)
            found = torch.cat([pool(self.backbone(part.float() / 255)) for part in pictures.split(BATCH)])
            if self.cache is not None:
                self.cache.put(flat, found)
                found = found.half().float()  # as the next reader of the cache has them
        return found.reshape(*batch, -1)

    def _apply_transform(self, frames: Tensor) -> Tensor:
        return self.embed(frames)

    def embed(self, frames: Tensor) -> Tensor:
        """Embeddings ``[*B, d]`` of frames ``[*B, H, W, 3]``."""
        features = self.features(frames.cpu())
        return (features if self.projection is None else self.projection(features)).to(frames.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the embeddings of the frames of a tensordict."""
        return tensordict.set(self.out_keys[0], self._apply_transform(tensordict.get(self.in_keys[0])))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the embedding to the spec."""
        batch = observation_spec[self.in_keys[0]].shape[:-3]
        probe = self._apply_transform(torch.zeros(self.size, self.size, 3, dtype=torch.uint8))
        observation_spec[self.out_keys[0]] = Unbounded((*batch, probe.shape[-1]), dtype=torch.float32)
        return observation_spec
