# This source code is licensed under the MIT license found in the LICENSE file.
"""Custom networks for `koap embed --network`."""

import torch
from torch import nn


def random_layer(seed: int = 0) -> nn.Module:
    """Returns one convolution with random weights: 4 channels, cells of 4 x 4 pixels."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return nn.Conv2d(3, 4, 4, stride=4)


def another_layer() -> nn.Module:
    return random_layer(1)
