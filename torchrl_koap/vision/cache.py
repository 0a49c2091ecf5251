# This source code is licensed under the MIT license found in the LICENSE file.
"""Pooled features on disk, so that frames go through the network once; a folder belongs to one set of weights."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from torch import Tensor

_ABOUT = "cache.json"


class CacheError(ValueError):
    """A cache that belongs to other weights or another pooling, or is no cache."""


class EmbeddingCache:
    """A folder with a file per batch of frames, named by the frames' SHA-256.

    Args:
        folder (str or Path): folder to create or go on with.
        identity (dict): what the features depend on: SHA-256 of the weights, stage, pooling, size of the frames.

    Raises:
        CacheError: if the folder is of other weights, or something else.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.vision import EmbeddingCache
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     cache, frames = EmbeddingCache(folder, {"weights": "ab"}), torch.zeros(2, 4, 4, 3, dtype=torch.uint8)
        ...     cache.get(frames), cache.put(frames, torch.ones(2, 5)), cache.get(frames).shape
        (None, None, torch.Size([2, 5]))
    """

    def __init__(self, folder: str | Path, identity: dict[str, str]):
        self.folder = Path(folder)
        about = self.folder / _ABOUT
        if about.is_file():
            found = json.loads(about.read_text())
            other = [name for name in identity.keys() | found.keys() if identity.get(name) != found.get(name)]
            if other:
                name = sorted(other)[0]
                raise CacheError(
                    f"the cache {self.folder} was made with {name} {str(found.get(name))[:16]}, wanted"
                    f" {str(identity.get(name))[:16]}: choose another folder, or delete it"
                )
        elif self.folder.exists() and any(self.folder.iterdir()):
            raise CacheError(f"{self.folder} is not empty and no cache ({_ABOUT} is missing): choose another folder")
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            about.write_text(json.dumps(identity, indent=1, sort_keys=True))

    def _file(self, frames: Tensor) -> Path:
        digest = hashlib.sha256(str(list(frames.shape)).encode() + frames.contiguous().numpy().tobytes()).hexdigest()
        return self.folder / f"{digest}.safetensors"

    def get(self, frames: Tensor) -> Tensor | None:
        """Features of these frames ``[N, H, W, 3]``, None if they are not there."""
        from safetensors.torch import load_file

        file = self._file(frames)
        return load_file(file)["features"].float() if file.is_file() else None

    def put(self, frames: Tensor, features: Tensor) -> None:
        """Keeps features in half precision.

        Args:
            frames (Tensor): uint8 ``[N, H, W, 3]``, by whose content they are found again.
            features (Tensor): ``[N, F]``.
        """
        from safetensors.torch import save_file

        file = self._file(frames)
        aside = file.with_suffix(".part")
        save_file({"features": features.half().contiguous()}, aside)
        aside.replace(file)
