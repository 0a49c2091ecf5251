# This source code is licensed under the MIT license found in the LICENSE file.
"""Where losses, scores and films go besides the run directory: one of TorchRL's loggers, whose package is optional."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.lookup import lookup

PROJECT = "koap"


def _wandb(out: Path) -> Any:
    from torchrl.record.loggers import WandbLogger

    mode = os.environ.get("WANDB_MODE", "offline")
    return WandbLogger(out.name, log_dir=str(out), mode=mode, project=PROJECT)


def _tensorboard(out: Path) -> Any:
    from torchrl.record.loggers import TensorboardLogger

    return TensorboardLogger("tensorboard", log_dir=str(out))


def _mlflow(out: Path) -> Any:
    from torchrl.record.loggers import MLFlowLogger

    uri = os.environ.get("MLFLOW_TRACKING_URI")
    if uri is not None:
        return MLFlowLogger(f"{PROJECT}-{out.name}", tracking_uri=uri)
    out = out.absolute()
    files = (out / "mlflow").as_uri()  # by itself MLflow would put them where the command was called
    return MLFlowLogger(f"{PROJECT}-{out.name}", tracking_uri=f"sqlite:///{out / 'mlflow.db'}", artifact_location=files)


# name to the module that it needs, and to what makes it; "csv" is metrics.csv, which there always is
LOGGERS: dict[str, tuple[str | None, Callable[[Path], Any] | None]] = {
    "csv": (None, None),
    "wandb": ("wandb", _wandb),
    "tensorboard": ("tensorboard", _tensorboard),
    "mlflow": ("mlflow", _mlflow),
}


def check_logger(name: str) -> None:
    """Refuses a logger that is unknown or whose package is not installed, before any work is done.

    Args:
        name (str): a name in ``LOGGERS``.

    Raises:
        ValueError: naming the nearest logger, or the extra to install.

    Examples:
        >>> from torchrl_koap.training.loggers import check_logger
        >>> check_logger("csv")
        >>> check_logger("wandbb")
        Traceback (most recent call last):
        ...
        ValueError: unknown logger 'wandbb'; did you mean 'wandb'?
    """
    module, _ = lookup(LOGGERS, name, "logger")
    if module is not None and importlib.util.find_spec(module) is None:
        raise ValueError(f"--logger {name} needs an extra: pip install 'torchrl_koap[{name}]'")


def make_logger(name: str, out: Path) -> Any | None:
    """A logger of TorchRL that writes into the run directory, unless the environment names a server.

    Args:
        name (str): a name in ``LOGGERS``.
        out (Path): the run directory.

    Returns:
        The logger, or None where ``metrics.csv`` is all that is asked for.
    """
    make = lookup(LOGGERS, name, "logger")[1]
    return None if make is None else make(out)


def log_evaluation(logger: Any, figures: Mapping[str, Any], films: Sequence[Path]) -> None:
    """Hands the figures of an evaluation to a logger, and its films as far as the logger can show them.

    Args:
        logger: what :func:`make_logger` returned.
        figures (mapping): name to value; those that are finite numbers are logged, as ``eval/NAME``.
        films (sequence of Path): gifs; wandb shows them as videos, TensorBoard as moving images, MLflow keeps them as
            files.
    """
    for name, value in figures.items():
        if isinstance(value, (int, float)) and math.isfinite(value):
            logger.log_scalar(f"eval/{name}", float(value), step=0)
    for film in films:
        _FILM[type(logger).__name__](logger, film)


def _film_in_wandb(logger: Any, film: Path) -> None:
    import wandb

    logger.experiment.log({f"eval/{film.stem}": wandb.Video(str(film), format="gif")})


def _film_in_tensorboard(logger: Any, film: Path) -> None:
    from PIL import Image
    from tensorboard.compat.proto.summary_pb2 import Summary

    with Image.open(film) as picture:
        width, height = picture.size
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=film.read_bytes())
    summary = Summary(value=[Summary.Value(tag=f"eval/{film.stem}", image=image)])
    logger.experiment._get_file_writer().add_summary(summary, 0)


def _film_in_mlflow(logger: Any, film: Path) -> None:
    import mlflow

    mlflow.log_artifact(str(film), "films")


_FILM = {
    "WandbLogger": _film_in_wandb,
    "TensorboardLogger": _film_in_tensorboard,
    "MLFlowLogger": _film_in_mlflow,
}


def close_logger(logger: Any | None) -> None:
    """Ends what a logger has begun; an MLflow run is ended too, so that the next one is a new one.

    Args:
        logger (optional): what :func:`make_logger` returned.
    """
    if logger is None:
        return
    logger.close()
    if type(logger).__name__ == "MLFlowLogger":
        import mlflow

        mlflow.end_run()
