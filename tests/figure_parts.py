# This source code is licensed under the MIT license found in the LICENSE file.
"""What is drawn in a figure, read back from it."""

from __future__ import annotations

from matplotlib.collections import LineCollection


def titles(figure):
    return [axes.get_title(loc="left") for axes in figure.axes]


def drawn_lines(axes):
    return [line for item in axes.collections if isinstance(item, LineCollection) for line in item.get_segments()]
