# This source code is licensed under the MIT license found in the LICENSE file.
"""A frozen network as a TorchRL transform, frames in, embeddings out, and the principal components behind it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_koap.data.ted import CAMERAS, stored_folder
from torchrl_koap.files import check_file, option, replacing_file
from torchrl_koap.keys import read_entry
from torchrl_koap.lookup import absolute
from torchrl_koap.vision.backbones import Backbone, WeightsError, load_backbone

BATCH = 32  # frames that go through the network at once
SHORT_SIDE = 96  # pixels that the network is shown of the shorter side of a frame


class FrozenImageEncoder(ObservationTransform):
    """Embeds camera frames: a frozen network, where its channels differ from their medians, principal components.

    Frames are ``pixels``, uint8 ``[*B, H, W, 3]``, and become ``embedding``, float32 ``[*B, d]``. Feature maps are
    pooled by :func:`pool_moments`.

    The network is shown 96 pixels of the shorter side of a frame, and all of it where it has fewer.

    Args:
        backbone (Backbone, optional): the network. Default: EfficientNet-Lite0
            (:func:`~torchrl_koap.vision.load_backbone`).

    Keyword Args:
        projection (nn.Module, optional): maps pooled features ``[*B, F]`` to embeddings ``[*B, d]``, such as a
            :class:`~torchrl_koap.vision.Projection`. Default: none, the features are the embedding.
        size (int, or sequence of int): height and width of the recorded frames. Frames of another size are resized,
            with a warning at the first one.

    Raises:
        WeightsError: if there are no weights.
        ValueError: in use, for frames of another dtype or without three colours, or a network that returns no features.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.vision import Backbone, FrozenImageEncoder
        >>> encoder = FrozenImageEncoder(Backbone(torch.nn.Conv2d(3, 8, 8, stride=8), "random", "one layer"))
        >>> encoder(TensorDict({"pixels": torch.zeros(2, 96, 96, 3, dtype=torch.uint8)}, [2]))["embedding"].shape
        torch.Size([2, 80])
    """

    def __init__(
        self, backbone: Backbone | None = None, *, projection: nn.Module | None = None, size: int | Sequence[int] = 96
    ):
        super().__init__(in_keys=["pixels"], out_keys=["embedding"])
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
        return pool_moments(maps) if maps.shape[2:].numel() > 1 else maps.flatten(1)

    def embed(self, frames: Tensor) -> Tensor:
        """Computes embeddings ``[*B, d]`` of frames, uint8 ``[*B, H, W, 3]``."""
        features = self.features(frames.cpu())
        return (features if self.projection is None else self.projection(features)).to(frames.device)

    _apply_transform = embed

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


def pool_moments(maps: Tensor) -> Tensor:
    """Computes where each channel differs from its median over the picture: ``[B, 10 C]`` of maps ``[B, C, h, w]``.

    Weighted by how far a channel is above its median, then by how far below: the centre (x, y, each from -1 to 1) and
    the central second moments (xx, yy, xy).
    """
    axes = [torch.linspace(-1, 1, side).to(maps) for side in maps.shape[2:]]
    y, x = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    powers = torch.stack([x, y, x * x, y * y, x * y], 1)
    flat = maps.flatten(2)
    away = flat - flat.median(-1, keepdim=True).values
    pooled = []
    for side in (away, -away):
        weights = side.clamp_min(0) + 1e-6  # a channel that is the same everywhere has its centre in the middle
        x, y, xx, yy, xy = ((weights / weights.sum(-1, keepdim=True)) @ powers).unbind(-1)
        pooled += [x, y, xx - x * x, yy - y * y, xy - x * y]
    return torch.cat(pooled, 1)


SCOOPING = Path(__file__).with_name("scooping.safetensors")


class Projection(nn.Module):
    """Principal components of pooled features, fitted on frames without labels.

    Args:
        mean (Tensor): ``[F]``.
        components (Tensor): ``[F, d]``; scaled so that the first component has variance 1.
        about (mapping, optional): what the features are of: :attr:`FrozenImageEncoder.identity`.

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

    def __init__(self, mean: Tensor, components: Tensor, about: Mapping[str, str] | None = None):
        super().__init__()
        self.about = dict(about or {})
        if mean.ndim != 1 or components.ndim != 2 or len(mean) != len(components):
            raise ValueError(
                f"mean must be [F] and components [F, d], got {list(mean.shape)} and {list(components.shape)}"
            )
        self.register_buffer("mean", mean)
        self.register_buffer("components", components)

    @classmethod
    def fit(cls, features: Tensor, dim: int, about: Mapping[str, str] | None = None) -> Projection:
        """Fits ``dim`` components to features ``[N, F]``, more of both, of frames that are not all alike."""
        if min(features.shape) <= dim:
            raise ValueError(f"{option('components')} must be below frames and features {[*features.shape]}, got {dim}")
        features = features.double()
        if bool((features == features[:1]).all()):
            raise ValueError(f"all {len(features)} frames look the same to the network: there is nothing to embed")
        mean = features.mean(0)
        _, values, axes = torch.linalg.svd(features - mean, full_matrices=False)
        axes = axes[:dim].T
        signs = axes.gather(0, axes.abs().argmax(0, keepdim=True)).sign()  # the same on every machine
        scale = values[0] / (len(features) - 1) ** 0.5
        return cls(mean.float(), (axes * signs / scale).float(), about)

    @property
    def dim(self) -> int:
        """Number of components."""
        return self.components.shape[1]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the frames that it was fitted to, by its description; a ValueError refuses another."""
        try:
            height, width = (int(side) for side in self.about["size"].split("x"))
        except ValueError as error:
            raise ValueError(f"the description of the projection cannot be used, size: {error}") from error
        return height, width

    @classmethod
    def load(cls, path: str | Path) -> Projection:
        """Reads a file that :meth:`save` wrote; no network is needed. One that is missing or damaged is refused."""
        if not Path(path).is_file():
            raise FileNotFoundError(f"no projection: there is no file {path}")
        check_file(path)
        try:
            with safe_open(str(path), "pt") as file:
                mean, components = (file.get_tensor(name).float() for name in ("mean", "components"))
                about = dict(file.metadata() or {})
            missing = [name for name in ("weights", "network", "size") if not about.get(name)]
            if missing:
                raise ValueError(f"its description has no {missing[0]!r}")
            return cls(mean, components, about)
        except Exception as error:  # what a damaged file makes of its reader
            raise ValueError(f"the projection {path} cannot be used: {error}") from error

    def save(self, path: str | Path) -> Path:
        """Writes it and what it belongs to, its components in half precision; returns the file."""
        tensors = {"mean": self.mean.contiguous(), "components": self.components.half().contiguous()}
        with replacing_file(path) as aside:
            save_file(tensors, aside, self.about)
        return Path(path)

    def find_network(self, files: Sequence[str]) -> None:
        """Takes the file of its network from among those given, if one has the same name."""
        file, _, name = self.about["network"].rpartition(":")
        for each in files:
            if Path(each).name == Path(file).name:
                self.about["network"] = f"{absolute(each)}:{name}"

    def kept(self, features: Tensor) -> float:
        """Computes the share of the variance of features ``[N, F]`` that reconstructed ones keep."""
        centred = (features - self.mean).double()
        axes = torch.linalg.qr(self.components.double())[0]
        left = (centred - centred @ axes @ axes.T).square().sum() / centred.square().sum().clamp_min(1e-12)
        return 1 - float(left)

    def forward(self, features: Tensor) -> Tensor:
        """Computes components ``[*B, d]`` of features ``[*B, F]``; refuses those of another size."""
        if features.shape[-1] != len(self.mean):
            raise ValueError(
                f"the projection was fitted on {len(self.mean)} features, got {features.shape[-1]}: another network,"
                " stage or size of the frames"
            )
        return (features - self.mean) @ self.components


def projection_of(task: str) -> Path:
    """Returns the file of a task's projection that comes with the package; a task without one is refused."""
    path = SCOOPING.with_stem(task)
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in SCOOPING.parent.glob("*.safetensors")))
        raise ValueError(f"no projection comes with the package for task {task!r} (only for {known}): pass your own")
    return path


def load_cameras(folder: str | Path) -> dict[str, Projection]:
    """Reads the projections in a folder, such as ``cameras`` of a run, by the name of the camera; needs no network."""
    return {file.stem: Projection.load(file) for file in sorted(Path(folder).glob("*.safetensors"))}


def cameras_of(dataset: str | Path | None) -> dict[str, Projection]:
    """Reads the projections that ``koap embed`` wrote beside a data set; none where its columns are no embeddings."""
    stored = None if dataset is None else stored_folder(Path(dataset).expanduser())
    return {} if stored is None else load_cameras(stored.parent / CAMERAS)


def load_encoder(projection: Projection | str | Path = SCOOPING, network: str | None = None) -> FrozenImageEncoder:
    """Makes the encoder that a projection was fitted behind.

    Args:
        projection (Projection, str or Path): it, or its file. Default: the one of Scooping that comes with the package.
        network (str, optional): see :func:`~torchrl_koap.vision.load_backbone`. Default: as it was fitted.

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
    fitted = projection if isinstance(projection, Projection) else Projection.load(projection)
    about, size = fitted.about, fitted.size
    backbone = load_backbone(network or about["network"])
    if backbone.digest != about["weights"]:
        raise WeightsError(
            f"the projection was fitted behind the weights {about['weights'][:12]} of {about['network']}, these are"
            f" {backbone.digest[:12]} of {backbone.name}: fit one for them, or pass the network it belongs to"
        )
    return FrozenImageEncoder(backbone, projection=fitted, size=size)
