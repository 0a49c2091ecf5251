# This source code is licensed under the MIT license found in the LICENSE file.
"""A frozen network as a TorchRL transform: frames in, embeddings out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_koap.keys import read_entry
from torchrl_koap.vision.backbones import Backbone, load_backbone

BATCH = 32  # frames that go through the network at once
GRID = 6  # cells of the pooling, both ways: averages of the whole picture forget where things are
SHORT_SIDE = 96  # pixels that the network is shown of the shorter side of a frame


class FrozenImageEncoder(ObservationTransform):
    """Embeds camera frames: a frozen network, means over a coarse grid, principal components.

    The network is shown 96 pixels of the shorter side of a frame, and all of it where it has fewer.

    Args:
        backbone (Backbone, optional): the network. Default: EfficientNet-Lite0
            (:func:`~torchrl_koap.vision.load_backbone`).

    Keyword Args:
        projection (nn.Module, optional): maps pooled features ``[*B, F]`` to embeddings ``[*B, d]``, such as a
            :class:`~torchrl_koap.vision.Projection`. Default: none, the features are the embedding.
        size (int, or sequence of int): height and width of the recorded frames. Frames of another size are resized,
            with a warning at the first one.
        in_key, out_key (str): frames, uint8 ``[*B, H, W, 3]``, and embeddings, float32 ``[*B, d]``.

    Raises:
        WeightsError: if there are no weights.
        ValueError: in use, for frames of another dtype or without three colours, or a network that returns no features.

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
        size: int | Sequence[int] = 96,
        in_key: str = "pixels",
        out_key: str = "embedding",
    ):
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        self.backbone = load_backbone() if backbone is None else backbone
        self.projection = projection
        self.size = (size, size) if isinstance(size, int) else (int(size[0]), int(size[1]))
        shorter = min(self.size)
        if shorter < 1:
            raise ValueError(f"size of the frames must be at least 1, got {size}")
        self._shown = tuple(round(side * min(1.0, SHORT_SIDE / shorter)) for side in self.size)
        self._told = False

    @property
    def identity(self) -> dict[str, str]:
        """What pooled features depend on: weights, network, size of maps and of frames."""
        maps = self.backbone(torch.zeros(1, 3, *self._shown))
        return {
            "weights": self.backbone.digest,
            "network": self.backbone.name,
            "places": "x".join(map(str, maps.shape[2:])),
            "pooling": "grid",
            "size": "x".join(map(str, self.size)),
        }

    @torch.no_grad()
    def features(self, frames: Tensor) -> Tensor:
        """Computes pooled features ``[*B, F]`` of frames, uint8 ``[*B, H, W, 3]``; all else is refused."""
        if frames.dtype != torch.uint8:
            raise ValueError(f"frames must be uint8 in 0 to 255, got {frames.dtype}")
        if frames.ndim < 3 or frames.shape[-1] != 3:
            raise ValueError(f"frames must be [*B, {self.size[0]}, {self.size[1]}, 3], got shape {list(frames.shape)}")
        got = tuple(frames.shape[-3:-1])
        if got != self.size and not self._told:
            self._told = True
            warnings.warn(
                f"frames are {got[0]} x {got[1]}, recorded were {self.size[0]} x {self.size[1]}: they are resized",
                stacklevel=2,
            )
        batch, pictures = frames.shape[:-3], frames.reshape(-1, *frames.shape[-3:]).permute(0, 3, 1, 2)
        pooled = [self._pooled(part.float() / 255) for part in pictures.split(BATCH)]
        return torch.cat(pooled).reshape(*batch, -1)

    def _pooled(self, pictures: Tensor) -> Tensor:
        """Features ``[B, F]`` of pictures ``[B, 3, H, W]`` in 0 to 1."""
        if tuple(pictures.shape[-2:]) != self._shown:
            pictures = F.interpolate(pictures, self._shown, mode="bilinear", antialias=True)
        maps = self.backbone(pictures.contiguous(memory_format=torch.channels_last))
        if not isinstance(maps, Tensor) or maps.ndim not in (2, 4):
            got = list(maps.shape) if isinstance(maps, Tensor) else type(maps).__name__
            raise ValueError(f"network {self.backbone.name!r} must return [B, C, h, w] or [B, F], got {got}")
        return F.adaptive_avg_pool2d(maps, GRID).flatten(1) if maps.ndim == 4 else maps

    def embed(self, frames: Tensor) -> Tensor:
        """Computes embeddings ``[*B, d]`` of frames, uint8 ``[*B, H, W, 3]``."""
        features = self.features(frames.cpu())
        return (features if self.projection is None else self.projection(features)).to(frames.device)

    def _apply_transform(self, frames: Tensor) -> Tensor:
        return self.embed(frames)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the embeddings of the frames of a tensordict."""
        return tensordict.set(self.out_keys[0], self.embed(read_entry(self, tensordict, self.in_keys[0])))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the embedding to the spec."""
        batch = observation_spec[self.in_keys[0]].shape[:-3]
        probe = self.embed(torch.zeros(*self.size, 3, dtype=torch.uint8))
        observation_spec[self.out_keys[0]] = Unbounded((*batch, probe.shape[-1]), dtype=torch.float32)
        return observation_spec
