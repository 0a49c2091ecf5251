# This source code is licensed under the MIT license found in the LICENSE file.
"""Residual networks with the parameter names of torchvision, so that its files of weights load without it."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

_DEPTHS = {
    "resnet18": ((2, 2, 2, 2), False),
    "resnet34": ((3, 4, 6, 3), False),
    "resnet50": ((3, 4, 6, 3), True),
}


class _Block(nn.Module):
    """Two 3x3 convolutions, or 1x1, 3x3, 1x1, and a shortcut around them."""

    def __init__(self, wide: int, width: int, stride: int, bottleneck: bool):
        super().__init__()
        out = 4 * width if bottleneck else width
        first, last = (1, 1) if bottleneck else (3, 3)
        self.conv1 = nn.Conv2d(wide, width, first, 1 if bottleneck else stride, first // 2, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        middle = width if bottleneck else out
        self.conv2 = nn.Conv2d(width, middle, 3, stride if bottleneck else 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(middle)
        if bottleneck:
            self.conv3 = nn.Conv2d(width, out, last, bias=False)
            self.bn3 = nn.BatchNorm2d(out)
        self.bottleneck = bottleneck
        self.relu = nn.ReLU()
        self.downsample = None
        if stride != 1 or wide != out:
            self.downsample = nn.Sequential(nn.Conv2d(wide, out, 1, stride, bias=False), nn.BatchNorm2d(out))

    def forward(self, maps: Tensor) -> Tensor:
        shortcut = maps if self.downsample is None else self.downsample(maps)
        out = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(maps)))))
        if self.bottleneck:
            out = self.bn3(self.conv3(self.relu(out)))
        return self.relu(out + shortcut)


class ResNet(nn.Module):
    """ResNet-18, -34 or -50.

    Args:
        name (str): which.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision.resnet import ResNet
        >>> ResNet("resnet18").up_to(16)(torch.zeros(1, 3, 96, 96)).shape
        torch.Size([1, 256, 6, 6])
    """

    def __init__(self, name: str = "resnet18"):
        super().__init__()
        self.name = name
        depths, bottleneck = _DEPTHS[name]
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU()
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        wide = 64
        for index, depth in enumerate(depths):
            width, blocks = 64 * 2**index, []
            for number in range(depth):
                blocks.append(_Block(wide, width, 2 if index and not number else 1, bottleneck))
                wide = 4 * width if bottleneck else width
            setattr(self, f"layer{index + 1}", nn.Sequential(*blocks))
        self.fc = nn.Linear(wide, 1000)

    @classmethod
    def like(cls, state: Mapping[str, Tensor]) -> ResNet:
        """The network that a state dict looks like."""
        if "layer1.0.conv3.weight" in state:
            return cls("resnet50")
        return cls("resnet34" if "layer1.2.conv1.weight" in state else "resnet18")

    def up_to(self, stride: int) -> nn.Sequential:
        """The network up to the stage in which a place of the maps stands for ``stride`` pixels (8, 16 or 32)."""
        stages = [self.layer1, self.layer2, self.layer3, self.layer4][: {8: 2, 16: 3, 32: 4}[stride]]
        return nn.Sequential(self.conv1, self.bn1, self.relu, self.maxpool, *stages)
