# This source code is licensed under the MIT license found in the LICENSE file.
"""A frozen network as a TorchRL transform: frames in, embeddings out."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_koap.vision.backbones import Backbone, load_backbone

BATCH = 64  # frames that go through the network at once
GRID = 6  # cells of the pooling, both ways: averages of the whole picture forget where things are


class FrozenImageEncoder(ObservationTransform):
    """Embeds camera frames: a frozen network, means over a coarse grid, principal components.

    Args:
        backbone (Backbone, optional): the network. Default: EfficientNet-Lite0
            (:func:`~torchrl_koap.vision.load_backbone`).

    Keyword Args:
        projection (nn.Module, optional): maps pooled features ``[*B, F]`` to embeddings ``[*B, d]``, such as a
            :class:`~torchrl_koap.vision.Projection`. Default: none, the features are the embedding.
        size (int): height and width that frames must have.
        in_key (str): entry with the frames, uint8 ``[*B, size, size, 3]``.
        out_key (str): entry of the embeddings, float32 ``[*B, d]``.

    Raises:
        WeightsError: if there are no weights.
        ValueError: in use, for frames of another size or dtype.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.vision import Backbone, FrozenImageEncoder
        >>> encoder = FrozenImageEncoder(Backbone(torch.nn.Conv2d(3, 8, 8, stride=8), "random", "one layer"))
        >>> encoder(TensorDict({"pixels": torch.zeros(2, 96, 96, 3, dtype=torch.uint8)}, [2]))["embedding"].shape
        torch.Size([2, 288])
    """

    def __init__(
        self,
        backbone: Backbone | None = None,
        *,
        projection: nn.Module | None = None,
        size: int = 96,
        in_key: str = "pixels",
        out_key: str = "embedding",
    ):
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        self.backbone = load_backbone() if backbone is None else backbone
        self.projection, self.size = projection, size

    @property
    def identity(self) -> dict[str, str]:
        """What pooled features depend on: weights, network, size of maps and of frames."""
        cells = [*self.backbone(torch.zeros(1, 3, self.size, self.size)).shape[-2:]]
        return {
            "weights": self.backbone.digest,
            "network": self.backbone.name,
            "places": "x".join(map(str, cells)),
            "pooling": "grid",
            "size": str(self.size),
        }

    @torch.no_grad()
    def features(self, frames: Tensor) -> Tensor:
        """Computes pooled features ``[*B, F]`` of frames, uint8 ``[*B, size, size, 3]``.

        Raises:
            ValueError: for frames of another dtype or size.
        """
        if frames.dtype != torch.uint8:
            raise ValueError(f"frames must be uint8 in 0 to 255, got {frames.dtype}")
        if frames.ndim < 3 or tuple(frames.shape[-3:]) != (self.size, self.size, 3):
            raise ValueError(f"frames must be [*B, {self.size}, {self.size}, 3], got shape {list(frames.shape)}")
        batch, pictures = frames.shape[:-3], frames.reshape(-1, *frames.shape[-3:]).permute(0, 3, 1, 2)
        maps = (self.backbone(part.float() / 255) for part in pictures.split(BATCH))
        return torch.cat([F.adaptive_avg_pool2d(part, GRID).flatten(1) for part in maps]).reshape(*batch, -1)

    def embed(self, frames: Tensor) -> Tensor:
        """Computes embeddings ``[*B, d]`` of frames, uint8 ``[*B, size, size, 3]``."""
        features = self.features(frames.cpu())
        return (features if self.projection is None else self.projection(features)).to(frames.device)

    def _apply_transform(self, frames: Tensor) -> Tensor:
        return self.embed(frames)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the embeddings of the frames of a tensordict."""
        return tensordict.set(self.out_keys[0], self.embed(tensordict.get(self.in_keys[0])))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the embedding to the spec."""
        batch = observation_spec[self.in_keys[0]].shape[:-3]
        probe = self.embed(torch.zeros(self.size, self.size, 3, dtype=torch.uint8))
        observation_spec[self.out_keys[0]] = Unbounded((*batch, probe.shape[-1]), dtype=torch.float32)
        return observation_spec
