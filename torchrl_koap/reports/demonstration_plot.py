# This source code is licensed under the MIT license found in the LICENSE file.
"""Picture of the demonstrations from above, and of which steps are labelled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchrl_koap.reports.objects import legend_handles, object_looks
from torchrl_koap.reports.offline_plots import plot_columns
from torchrl_koap.reports.paths import draw_bodies, entry_of, has_objects, keep_inside
from torchrl_koap.reports.pictures import picture
from torchrl_koap.reports.scenes import draw_scene
from torchrl_koap.reports.style import BLUE, as_array, save_figure, set_title


@picture(
    "demonstrations.png",
    source="demonstrations.safetensors",
    title="Demonstrations and labels",
    caption="Blue: transitions whose action the training may read. Grey: states only.",
    caption_of=has_objects(" Beside it the objects that were moved."),
    place=80,
)
def _draw_demonstrations(
    demonstrations: Mapping[str, Any],
    path: Path,
    *,
    task: str | None,
    columns: Sequence[tuple[str, str]] | None = None,
    control_hz: float | None = None,
) -> Path:
    if columns is not None:  # no environment says what lies in a plane
        return plot_columns(demonstrations, path, columns=columns, control_hz=control_hz)
    return plot_demonstrations(demonstrations, path, task=task)


def plot_demonstrations(demonstrations: Mapping[str, Any], path: str | Path, *, task: str | None = "avoiding") -> Path:
    """Paths of the demonstrations; transitions with an action label are emphasised, the others grey.

    Args:
        demonstrations (mapping): ``episode`` [N], ``labelled`` [N] and ``position`` [N, 2] (m) or, in files that have
            none, ``state`` [N, d], whose first two columns are the position; optionally ``objects`` [N, objects, 2]
            (m), which get a panel of their own.
        path (str or Path): png to write.
        task (str, optional): task whose scene is drawn.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.reports.demonstration_plot import plot_demonstrations
        >>> data = {"position": torch.rand(6, 2), "episode": [0, 0, 0, 1, 1, 1], "labelled": [True] * 3 + [False] * 3}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_demonstrations(data, f"{folder}/demonstrations.png").name
        'demonstrations.png'
    """
    if "position" in demonstrations:
        position = as_array("position", demonstrations["position"], [None, 2])
    else:
        position = as_array("state", entry_of(demonstrations, "state"), [None, None])[:, :2]
    episode = as_array("episode", entry_of(demonstrations, "episode"), [len(position)])
    labelled = as_array("labelled", entry_of(demonstrations, "labelled"), [len(position)]).astype(bool)
    borders = np.flatnonzero(np.diff(episode) != 0) + 1
    paths = np.split(position, borders)
    if "objects" in demonstrations:
        bodies = as_array("objects", demonstrations["objects"], [len(position), None, 2])
        figure = Figure(figsize=(10.9, 6.2), layout="constrained")
        axes, beside = figure.subplots(1, 2)
        draw_scene(beside, task).label_outer()
        draw_bodies(beside, np.split(bodies, borders), None, task, [True] * len(paths))
        entries = legend_handles([look for look in object_looks(task, bodies.shape[1]) if not look.still], [True])
        beside.legend(handles=entries, frameon=False, fontsize=8.5, loc="upper left", bbox_to_anchor=(1, 1))
        set_title(beside, "objects: paths and where they end\n")
    else:
        figure = Figure(figsize=(5.9, 6.4), layout="constrained")
        axes = figure.add_subplot()
    draw_scene(axes, task)
    axes.add_collection(LineCollection(paths, colors="#9aa1ab", linewidths=0.7, alpha=0.8, zorder=2))
    same = np.flatnonzero(labelled[:-1] & (episode[1:] == episode[:-1]))
    segments = np.stack([position[same], position[same + 1]], axis=1)
    axes.add_collection(LineCollection(segments, colors=BLUE, linewidths=1.7, capstyle="round", zorder=3))
    keep_inside(axes, paths)
    touched = len(np.unique(episode[labelled]))
    share = f"{labelled.mean():.1%}" if len(labelled) else "none"
    head = f"{len(paths)} demonstrations; labels on {int(labelled.sum()):,} of {len(labelled):,} transitions ({share})"
    set_title(axes, f"{head}\nin {touched} of {len(paths)} demonstrations")
    handles = [
        Line2D([], [], color=BLUE, linewidth=1.7, label="with action label"),
        Line2D([], [], color="#9aa1ab", linewidth=0.9, label="states only"),
    ]
    axes.legend(handles=handles, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False)
    return save_figure(figure, path)
