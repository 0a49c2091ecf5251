# This source code is licensed under the MIT license found in the LICENSE file.
"""Where losses go besides ``metrics.csv``: one of TorchRL's loggers, whose package is optional."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
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

    uri = os.environ.get("MLFLOW_TRACKING_URI", f"sqlite:///{(out / 'mlflow.db').absolute()}")
    return MLFlowLogger(f"{PROJECT}-{out.name}", tracking_uri=uri)


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
