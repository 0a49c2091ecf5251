# This source code is licensed under the MIT license found in the LICENSE file.
"""A frozen network as a TorchRL transform from frames to embeddings, and its principal components."""

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
from torchrl_koap.vision.backbones import Backbone, load_backbone

BATCH = 32  # frames that the network processes at once
SHORT_SIDE = 96  # pixels; frames with a longer short side are scaled down to it


class FrozenImageEncoder(ObservationTransform):
    """Embeds camera frames by a frozen network, moments of its channels and principal components.

    Frames are ``pixels``, uint8 ``[*B, H, W, 3]``; embeddings are ``embedding``, float32 ``[*B, d]``. Feature maps are
    pooled by :func:`pool_moments`.

    Frames whose shorter side exceeds 96 pixels are scaled down to 96 pixels for the network.

    Args:
        backbone (Backbone, optional): the network. Default: EfficientNet-Lite0
            (:func:`~torchrl_koap.vision.load_backbone`).

    Keyword Args:
        projection (nn.Module, optional): maps pooled features ``[*B, F]`` to embeddings ``[*B, d]``, for example a
            :class:`~torchrl_koap.vision.Projection`. Default: features are the embedding.
        size (int, or sequence of int): height and width of the recorded frames. Frames of another size are resized,
            with a warning at the first one.

    Raises:
        RuntimeError: if the extra with the default network is missing.
        ValueError: in use, for frames that are not uint8 or not of three colours, or a network without feature output.

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
        self._warned = False

    @property
    def identity(self) -> dict[str, str]:
        """All that pooled features depend on: weights, network, sizes of feature maps and of frames."""
        maps = self.backbone(torch.zeros(1, 3, *self._shown))
        return {
            "weights": self.backbone.digest,
            "network": self.backbone.name,
            "places": "x".join(map(str, maps.shape[2:])),
            "size": "x".join(map(str, self.size)),
        }

    @torch.no_grad()
    def features(self, frames: Tensor) -> Tensor:
        """Computes pooled features ``[*B, F]`` of frames, uint8 ``[*B, H, W, 3]``; raises a ValueError for others."""
        if frames.dtype != torch.uint8:
            raise ValueError(f"frames must be uint8 in 0 to 255, got {frames.dtype}")
        if frames.ndim < 3 or frames.shape[-1] != 3:
            raise ValueError(f"frames must be [*B, {self.size[0]}, {self.size[1]}, 3], got shape {list(frames.shape)}")
        got = tuple(frames.shape[-3:-1])
        if got != self.size and not self._warned:
            self._warned = True
            warnings.warn(
                f"frames are {got[0]} x {got[1]}, recorded were {self.size[0]} x {self.size[1]}: they are resized",
                stacklevel=2,
            )
        batch, pictures = frames.shape[:-3], frames.reshape(-1, *frames.shape[-3:]).permute(0, 3, 1, 2)
        pooled = [self._pooled(part.float() / 255) for part in pictures.split(BATCH)]
        return torch.cat(pooled).reshape(*batch, -1)

    def _pooled(self, pictures: Tensor) -> Tensor:
        """Computes features ``[B, F]`` of pictures ``[B, 3, H, W]`` in 0 to 1."""
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
        """Writes the embeddings of the frames."""
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
    """Computes moments ``[B, 10 C]`` of the regions where maps ``[B, C, h, w]`` differ from each channel's median.

    Weights are the amounts by which a channel exceeds its median over the picture, then those by which it falls below.
    The moments are the centre (x, y, from -1 to 1) and the central second moments (xx, yy, xy).
    """
    axes = [torch.linspace(-1, 1, side).to(maps) for side in maps.shape[2:]]
    y, x = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    powers = torch.stack([x, y, x * x, y * y, x * y], 1)
    flat = maps.flatten(2)
    deviation = flat - flat.median(-1, keepdim=True).values
    pooled = []
    for side in (deviation, -deviation):
        weights = side.clamp_min(0) + 1e-6  # the centre of a constant channel is the middle of the picture
        x, y, xx, yy, xy = ((weights / weights.sum(-1, keepdim=True)) @ powers).unbind(-1)
        pooled += [x, y, xx - x * x, yy - y * y, xy - x * y]
    return torch.cat(pooled, 1)


SCOOPING = Path(__file__).with_name("scooping.safetensors")


class Projection(nn.Module):
    """Principal components of pooled features, fitted on frames without labels.

    Args:
        mean (Tensor): ``[F]``.
        components (Tensor): ``[F, d]``; scaled so that the first component has variance 1.
        about (mapping, optional): the :attr:`FrozenImageEncoder.identity` of the features.

    Raises:
        ValueError: if mean or components have the wrong shape.

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
        """Fits ``dim`` components to features ``[N, F]``; ``N`` and ``F`` must exceed ``dim``, and rows differ."""
        if min(features.shape) <= dim:
            raise ValueError(f"{option('components')} must be below frames and features {[*features.shape]}, got {dim}")
        features = features.double()
        if bool((features == features[:1]).all()):
            raise ValueError(f"all {len(features)} frames look the same to the network: there is nothing to embed")
        mean = features.mean(0)
        _, values, axes = torch.linalg.svd(features - mean, full_matrices=False)
        axes = axes[:dim].T
        signs = axes.gather(0, axes.abs().argmax(0, keepdim=True)).sign()  # fixed signs, the same on every machine
        scale = values[0] / (len(features) - 1) ** 0.5
        return cls(mean.float(), (axes * signs / scale).float(), about)

    @property
    def dim(self) -> int:
        """Number of components."""
        return self.components.shape[1]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the frames that it was fitted to; a ValueError if its description has a bad size."""
        try:
            height, width = (int(side) for side in self.about["size"].split("x"))
        except ValueError as error:
            raise ValueError(f"the description of the projection cannot be used, size: {error}") from error
        return height, width

    @classmethod
    def load(cls, path: str | Path) -> Projection:
        """Reads a file of :meth:`save`, without the network; raises an error if it is missing or damaged."""
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
        except Exception as error:  # safetensors raises various exceptions for damaged files
            raise ValueError(f"the projection {path} cannot be used: {error}") from error

    def save(self, path: str | Path) -> Path:
        """Writes it and its description, the components in half precision; returns the file."""
        tensors = {"mean": self.mean.contiguous(), "components": self.components.half().contiguous()}
        with replacing_file(path) as aside:
            save_file(tensors, aside, self.about)
        return Path(path)

    def find_network(self, files: Sequence[str]) -> None:
        """Points its network to the one of the given files that has the same file name, if there is one."""
        file, _, name = self.about["network"].rpartition(":")
        for each in files:
            if Path(each).name == Path(file).name:
                self.about["network"] = f"{absolute(each)}:{name}"

    def kept(self, features: Tensor) -> float:
        """Computes the share of the variance of features ``[N, F]`` that their reconstruction keeps."""
        centred = (features - self.mean).double()
        axes = torch.linalg.qr(self.components.double())[0]
        left = (centred - centred @ axes @ axes.T).square().sum() / centred.square().sum().clamp_min(1e-12)
        return 1 - float(left)

    def forward(self, features: Tensor) -> Tensor:
        """Computes components ``[*B, d]`` of features ``[*B, F]``; raises a ValueError for another ``F``."""
        if features.shape[-1] != len(self.mean):
            raise ValueError(
                f"the projection was fitted on {len(self.mean)} features, got {features.shape[-1]}: use the same"
                " network, stage and size of the frames"
            )
        return (features - self.mean) @ self.components


def projection_of(task: str) -> Path:
    """Returns the file of a task's projection in the package; raises a ValueError for a task without one."""
    path = SCOOPING.with_stem(task)
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in SCOOPING.parent.glob("*.safetensors")))
        raise ValueError(f"the package has no projection for task {task!r} (only for {known}): pass your own")
    return path


def load_cameras(folder: str | Path) -> dict[str, Projection]:
    """Reads the projections in a folder, such as ``cameras`` of a run, by camera name; needs no network."""
    return {file.stem: Projection.load(file) for file in sorted(Path(folder).glob("*.safetensors"))}


def cameras_of(dataset: str | Path | None) -> dict[str, Projection]:
    """Reads the projections that ``koap embed`` wrote beside a data set; empty if there are none."""
    stored = None if dataset is None else stored_folder(Path(dataset).expanduser())
    return {} if stored is None else load_cameras(stored.parent / CAMERAS)


def load_encoder(projection: Projection | str | Path = SCOOPING, network: str | None = None) -> FrozenImageEncoder:
    """Makes the encoder whose features a projection was fitted to.

    Args:
        projection (Projection, str or Path): the projection or its file. Default: that of Scooping in the package.
        network (str, optional): see :func:`~torchrl_koap.vision.load_backbone`. Default: that of the projection.

    Returns:
        FrozenImageEncoder: frozen, in evaluation mode.

    Raises:
        RuntimeError: if the extra with the network is missing.
        ValueError: if its weights differ from those that the projection was fitted with.
        FileNotFoundError: if the file does not exist.

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
        raise ValueError(
            f"the projection was fitted with weights {about['weights'][:12]} of {about['network']}, got"
            f" {backbone.digest[:12]} of {backbone.name}: fit a projection for them, or pass its network"
        )
    return FrozenImageEncoder(backbone, projection=fitted, size=size)
