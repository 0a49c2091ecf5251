# This source code is licensed under the MIT license found in the LICENSE file.
"""Encoders whose projection lies in a file, with what it was fitted behind."""

from __future__ import annotations

from pathlib import Path

from torchrl_koap.vision.backbones import WeightsError, load_backbone
from torchrl_koap.vision.encoder import FrozenImageEncoder
from torchrl_koap.vision.pooling import Projection

SCOOPING = Path(__file__).with_name("scooping.safetensors")


def projection_of(task: str) -> Path:
    """The file of a task's projection that comes with the package.

    Args:
        task (str): name of the task, ``"scooping"`` or ``"scooping_moving_bowl"``.

    Raises:
        ValueError: if none was fitted for the task.

    Examples:
        >>> from torchrl_koap.vision.projections import projection_of
        >>> projection_of("scooping").name
        'scooping.safetensors'
    """
    path = SCOOPING.with_stem(task)
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in SCOOPING.parent.glob("*.safetensors")))
        raise ValueError(f"no projection comes with the package for task {task!r} (only for {known}): pass your own")
    return path


def save_encoder(encoder: FrozenImageEncoder, path: str | Path, *, stride: int, fitted_on: str) -> Path:
    """Writes an encoder's projection and what it belongs to; the network's weights stay where they are.

    Args:
        encoder (FrozenImageEncoder): with a projection.
        path (str or Path): file to write.

    Keyword Args:
        stride (int): of the network's stage.
        fitted_on (str): which frames it was fitted on, in words.

    Raises:
        ValueError: if the encoder has no projection.
    """
    if encoder.projection is None:
        raise ValueError("the encoder has no projection: there is nothing to save")
    return encoder.projection.save(path, encoder.identity | {"stride": str(stride), "fitted_on": fitted_on})


def load_encoder(
    projection: str | Path | None = None, weights: str | Path | None = None, *, cache: str | Path | None = None
) -> FrozenImageEncoder:
    """An encoder from a file that :func:`save_encoder` wrote.

    Args:
        projection (str or Path, optional): the file. Default: the one of Scooping that comes with the package.
        weights (str or Path, optional): see :func:`~torchrl_koap.vision.load_backbone`.

    Keyword Args:
        cache (str or Path, optional): folder for pooled features.

    Raises:
        WeightsError: if there are no weights, or others than those the projection was fitted behind.
        FileNotFoundError: if there is no such file.
    """
    fitted, about = Projection.load(SCOOPING if projection is None else projection)
    backbone = load_backbone(weights, stride=int(about["stride"]))
    if backbone.digest != about["weights"]:
        raise WeightsError(
            f"the projection was fitted behind the weights {about['weights'][:12]} of {about['network']}, these are"
            f" {backbone.digest[:12]} of {backbone.name}: fit one for them, or pass the weights it belongs to"
        )
    return FrozenImageEncoder(
        backbone, pooling=about["pooling"], projection=fitted, size=int(about["size"]), cache=cache
    )
