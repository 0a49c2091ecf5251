# This source code is licensed under the MIT license found in the LICENSE file.
"""Frozen image encoders: camera frames in, embeddings that keep where things are out."""

from torchrl_koap.lookup import exports

_LAZY = {
    "Alignment": "torchrl_koap.vision.alignment",
    "CacheError": "torchrl_koap.vision.cache",
    "EmbeddingCache": "torchrl_koap.vision.cache",
    "FrozenImageEncoder": "torchrl_koap.vision.encoder",
    "Projection": "torchrl_koap.vision.pooling",
    "WeightsError": "torchrl_koap.vision.backbones",
    "fit_alignment": "torchrl_koap.vision.alignment",
    "load_backbone": "torchrl_koap.vision.backbones",
}

__all__ = [  # noqa: F822 - __getattr__ finds them
    "Alignment",
    "CacheError",
    "EmbeddingCache",
    "FrozenImageEncoder",
    "Projection",
    "WeightsError",
    "fit_alignment",
    "load_backbone",
]

__getattr__ = exports(__name__, _LAZY)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
