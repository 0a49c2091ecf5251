# This source code is licensed under the MIT license found in the LICENSE file.
"""Frozen image encoders, which map camera frames to embeddings that retain positions."""

from torchrl_koap.vision.backbones import Backbone, load_backbone
from torchrl_koap.vision.encoder import FrozenImageEncoder, Projection, load_encoder
from torchrl_koap.vision.observer import Observer

__all__ = ["Backbone", "FrozenImageEncoder", "Observer", "Projection", "load_backbone", "load_encoder"]
