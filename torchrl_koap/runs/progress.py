# This source code is licensed under the MIT license found in the LICENSE file.
"""Progress bars, whose errors never stop a training, and loggers in addition to ``metrics.csv``."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import math
import os
import stat
import sys
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TextIO

from tqdm import tqdm

from torchrl_koap.lookup import lookup

LOGGERS = ("csv", "wandb", "tensorboard")  # csv: metrics.csv, which is always written

FILE_INTERVAL = 30.0  # s between the lines of a bar in a file
_UP = "\x1b[A"  # moves the cursor a line up
_SHOWN: ContextVar[bool] = ContextVar("shown", default=True)


class _Forgiving:
    """A stream that ignores write errors (a full device, a closed terminal)."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()


class _Lines(_Forgiving):
    """A stream that writes a line whenever a bar is drawn, instead of a carriage return."""

    def write(self, text: str) -> int:
        if line := text.replace(_UP, "").strip("\r\n "):
            super().write(line + "\n")
        return len(text)


def _is_on_disk(stream: TextIO) -> bool:
    """Returns whether a stream is a file on disk, in which carriage returns would give one endless line."""
    try:
        return isinstance(stream, io.TextIOWrapper) and stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
    except (OSError, ValueError):
        return False


def progress_bar(total: int | None, description: str, *, unit: str = "it", **options: Any) -> tqdm:
    """Makes a bar on stderr that counts to ``total``; it is not shown if stderr cannot be written to.

    If stderr is a file (the log of a cell, ``2> log.txt``), the bar is a line every half minute and at the end. The
    options are those of ``tqdm``.
    """
    disable = not _SHOWN.get() or sys.stderr is None
    stream: _Forgiving | None = None
    if not disable and _is_on_disk(sys.stderr):
        stream = _Lines(sys.stderr)
        options |= {"mininterval": FILE_INTERVAL, "maxinterval": FILE_INTERVAL}
    elif not disable:
        stream = _Forgiving(sys.stderr)
        options |= {"dynamic_ncols": True}  # the width of the terminal, which tqdm finds for sys.stderr itself only
    return tqdm(total=total, desc=description, unit=unit, disable=disable, file=stream, **options)


@contextlib.contextmanager
def without_progress_bars() -> Iterator[None]:
    """Hides the library's progress bars inside the block."""
    token = _SHOWN.set(False)
    try:
        yield
    finally:
        _SHOWN.reset(token)


def count_up_to(bar: tqdm) -> Callable[..., None]:
    """Makes a function ``move(done, total)`` that moves a bar to ``done``."""

    def move(done: int, total: int | None = None, *rest: Any) -> None:
        bar.total = bar.total if total is None else total
        bar.update(done - bar.n)

    return move


def show_losses(bar: tqdm) -> Callable[[int, dict[str, float]], None]:
    """Makes the function that a training calls after every update: it moves the bar and shows the losses."""

    def update(step: int, values: dict[str, float]) -> None:
        bar.update(step - bar.n)
        if values and step % 50 == 0:
            shown = {key: value for key, value in values.items() if "loss" in key or key == "held_out_score"}
            losses = {key.removeprefix("loss_"): f"{value:.3g}" for key, value in shown.items()}
            bar.set_postfix(losses, refresh=False)  # the next drawing of the bar shows it

    return update


def check_logger(name: str) -> None:
    """Raises a ValueError for a logger that is unknown (naming the nearest) or not installed (naming the extra)."""
    lookup(LOGGERS, name, "logger")
    if name != "csv" and importlib.util.find_spec(name) is None:
        raise ValueError(f"--logger {name} needs an extra: pip install 'torchrl_koap[{name}]'")


@contextlib.contextmanager
def open_logger(name: str, out: Path, options: Mapping[str, Any]) -> Iterator[Any | None]:
    """Yields a TorchRL logger that writes into the run directory, and closes it at the end of the block.

    For ``"csv"`` it is None. ``options``, JSON objects by section, are logged as hyperparameters ``SECTION.NAME``.
    wandb stays offline unless ``WANDB_MODE`` is set. The name must have passed :func:`check_logger`.
    """
    if name == "csv":
        yield None
        return
    from torchrl.record.loggers import get_logger

    title = out.name if name == "wandb" else name
    mode = {"project": "koap", "mode": os.environ.get("WANDB_MODE", "offline")}
    logger = get_logger(name, str(out), title, wandb_kwargs=mode)
    try:
        logger.log_hparams(_flat(options))
        yield logger
    finally:
        logger.close()


def _flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, bool | int | float | str]:
    """Returns options by their names with sections; what is no number becomes text."""
    flat: dict[str, bool | int | float | str] = {}
    for name, value in options.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value if isinstance(value, (bool, int, float)) else str(value)
    return flat


def log_scores(logger: Any, scores: Mapping[str, Any]) -> None:
    """Logs the scores of an evaluation that are finite numbers, as ``eval/NAME``."""
    numbers = {name: v for name, v in scores.items() if isinstance(v, (int, float)) and math.isfinite(v)}
    logger.log_metrics({f"eval/{name}": float(value) for name, value in numbers.items()}, step=0)
