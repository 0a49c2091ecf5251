# This source code is licensed under the MIT license found in the LICENSE file.
"""Frozen image encoders: camera frames in, embeddings that keep where things are out."""

from torchrl_koap.vision.backbones import Backbone, WeightsError, load_backbone
from torchrl_koap.vision.encoder import FrozenImageEncoder
from torchrl_koap.vision.observer import Observer
from torchrl_koap.vision.projection import Projection, load_encoder

__all__ = [
    "Backbone",
    "FrozenImageEncoder",
    "Observer",
    "Projection",
    "WeightsError",
    "load_backbone",
    "load_encoder",
]
