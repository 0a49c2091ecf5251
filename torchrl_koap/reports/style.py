# This source code is licensed under the MIT license found in the LICENSE file.
"""The look that all pictures share: colours, marks, frames, units, how arrays come in and files go out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_koap.tasks.units import thousandths as thousandths

INK, MUTED, FAINT, PALE = "#1f2328", "#6b7280", "#c9ced6", "#f4f5f7"
RED, GREEN, BLUE, ORANGE = "#cf222e", "#1a7f37", "#1f6feb", "#d9730d"
PALE_BLUE, WARNING = "#9cc3f5", "#9a3412"
SERIES = (BLUE, ORANGE, GREEN, "#8250df", "#bf3989", "#0a7f7f", MUTED)
TIMEOUT, SUCCESS, COLLISION = 0, 1, 2
OUTCOMES = {TIMEOUT: "out of time", SUCCESS: "success", COLLISION: "collision"}
FAILURE_MARKS = {TIMEOUT: "s", COLLISION: "X"}
NO_MODE = "#8a919c"


def as_array(name: str, value: Any, shape: Sequence[int | None]) -> np.ndarray:
    """Turns a tensor or array into a numpy array and checks its shape.

    Args:
        name (str): name used in the message.
        value (torch.Tensor or array): the values.
        shape (sequence of int or None): size of every axis; None allows any.

    Raises:
        ValueError: if the shape is another one.

    Examples:
        >>> import torch
        >>> from torchrl_koap.reports.style import as_array
        >>> as_array("real", torch.ones(3), [None]).tolist()
        [1.0, 1.0, 1.0]
    """
    if hasattr(value, "detach"):  # a tensor; torch itself is not imported, that takes seconds
        value = value.detach().cpu().numpy()
    value = np.asarray(value)
    if value.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, value.shape, strict=False)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name!r} must have shape [{wanted}], got {list(value.shape)}")
    return value


def save_figure(figure: Figure, path: str | Path, *, dpi: int = 150) -> Path:
    """Writes a figure as png, aside first, so that an earlier picture is replaced whole or not at all.

    Args:
        figure (Figure): what was drawn.
        path (str or Path): png to write.
        dpi (int): dots per inch.

    Returns:
        Path: the file.
    """
    from torchrl_koap.files import replacing_file  # imports torch: only when something is written

    path = Path(path)
    with replacing_file(path) as aside:
        figure.savefig(aside, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    return path


def tidy(axes: Axes) -> Axes:
    """Light frame, small ticks and labels."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(which="both", color=FAINT, labelsize=8, labelcolor=MUTED)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_size(9)
        label.set_color(INK)
    return axes


def set_title(axes: Axes, text: str) -> None:
    """Title of a panel, flush left.

    Args:
        axes (Axes): the panel.
        text (str): one or several lines.
    """
    axes.set_title(text, loc="left", fontsize=9.5, color=INK, linespacing=1.35)


def legend_beside(axes: Axes, **options: Any) -> None:
    """Legend to the right of a panel, where it hides nothing.

    Args:
        axes (Axes): the panel; artists with a label become entries.
        **options: further arguments of ``Axes.legend``.
    """
    place = {"loc": "upper left", "bbox_to_anchor": (1.01, 1), "borderaxespad": 0}
    axes.legend(**({"frameon": False, "fontsize": 8} | place | options))
