# This source code is licensed under the MIT license found in the LICENSE file.
"""All pictures of a run directory, from the files that training and evaluation left there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from torchrl_koap.reports.animation import animate_rollouts, render_rollout
from torchrl_koap.reports.mode_plots import plot_modes
from torchrl_koap.reports.rollout_plots import SUCCESS, plot_demonstrations, plot_plans, plot_rollouts
from torchrl_koap.reports.training_plots import plot_actions, plot_eigenvalues, plot_losses
from torchrl_koap.tasks.registry import find_task
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

FOLDER = "plots"


@dataclass(frozen=True)
class Picture:
    """One picture of a run.

    Args:
        name (str): file name inside ``plots/``.
        source (str): file of the run directory it is drawn from.
        command (str): the ``koap`` command that leaves this file, ``{run}`` stands for the directory.
        draw (callable): called with the run directory, the picture's path, and ``task``, ``num_modes``.
    """

    name: str
    source: str
    command: str
    draw: Callable[..., Path]


class NotFilmed(RuntimeError):
    """No OpenGL library can be used here; everything else can be drawn."""


def draw_pictures(
    run_dir: str | Path, *, animation: bool = True, progress: Callable[[int, int], None] | None = None
) -> dict[str, str]:
    r"""Draws every picture whose data are there into ``plots/``; one that fails does not stop the others.

    Args:
        run_dir (str or Path): the run directory.
        animation (bool): draw the moving pictures too (a second from above, some more for the film).
        progress (callable, optional): called with (pictures looked at, pictures in all).

    Returns:
        dict: what went wrong, a message per picture that could not be drawn although its data are there. A picture
        whose data are absent is not an error.

    Raises:
        FileNotFoundError: if there is no such directory.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_koap.reports.pictures import draw_pictures
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "metrics.csv").write_text("phase,step,loss_planner\nplanner,1,0.5\nplanner,2,0.4\n")
        ...     draw_pictures(folder), sorted(path.name for path in Path(folder, "plots").iterdir())
        ({}, ['losses.png'])
    """
    run_dir = Path(run_dir)
    if not run_dir.is_dir():
        raise FileNotFoundError(f"there is no run directory {str(run_dir)!r}")
    names = task_names(run_dir)
    problems = {}
    for number, picture in enumerate(PICTURES):
        if (run_dir / picture.source).exists() and (animation or not picture.name.endswith(".gif")):
            try:
                picture.draw(run_dir, run_dir / FOLDER / picture.name, **names)
            except NotFilmed as error:
                problems[picture.name] = f"{picture.name} was not made: {error}"
            except (ValueError, KeyError, OSError, SafetensorError) as error:
                problems[picture.name] = f"{picture.source}: {error}"
        if progress is not None:
            progress(number + 1, len(PICTURES))
    return problems


def task_names(run_dir: Path) -> dict[str, Any]:
    """Task of the run, if its scene can be drawn, and number of modes, as keyword arguments of the pictures."""
    try:
        task = RunDirectory(run_dir).read_json("config.json").get("task")
    except (RunDirectoryError, AttributeError):
        task = None
    facts = find_task(task)
    return {"task": facts.name if facts else None, "num_modes": facts.num_modes if facts else 24}


def _losses(run_dir: Path, path: Path, **_: Any) -> Path:
    rows = RunDirectory(run_dir).read_metrics()
    if not rows:
        raise ValueError("no row has been logged yet")
    columns = {}
    for name in rows[0]:
        if name == "step" or (name or "").startswith("loss_"):
            columns[name] = [float(row[name]) if row[name] else np.nan for row in rows]
    return plot_losses(columns, path)


def _rollouts(run_dir: Path, path: Path, **names: Any) -> Path:
    return plot_rollouts(load_file(run_dir / "rollouts.safetensors"), path, **names)


def _animation(run_dir: Path, path: Path, **names: Any) -> Path:
    return animate_rollouts(load_file(run_dir / "rollouts.safetensors"), path, **names)


def _film(run_dir: Path, path: Path, *, task: str | None, **_: Any) -> Path:
    rollouts = load_file(run_dir / "rollouts.safetensors")
    if task is None or "action" not in rollouts:  # a file of before actions were kept
        return path
    won = np.flatnonzero(rollouts["outcome"] == SUCCESS)
    index = int(won[0]) if len(won) else 0
    context = rollouts["context"][index] if "context" in rollouts else None
    try:
        return render_rollout(rollouts["action"][index], path, task=task, context=context)
    except RuntimeError as error:
        raise NotFilmed(error) from error


def _plans(run_dir: Path, path: Path, **names: Any) -> Path:
    rollouts = load_file(run_dir / "rollouts.safetensors")
    if rollouts["plan"].shape[1]:
        return plot_plans(rollouts, path, **names)
    path.unlink(missing_ok=True)  # plans of joints, or none kept: an earlier picture shows other rollouts
    return path


def _modes(run_dir: Path, path: Path, **names: Any) -> Path:
    rollouts = load_file(run_dir / "rollouts.safetensors")
    demonstrations = run_dir / "demonstrations.safetensors"
    reference = load_file(demonstrations).get("mode") if demonstrations.exists() else None
    return plot_modes(rollouts["mode"][rollouts["outcome"] == SUCCESS], path, reference=reference, **names)


def _demonstrations(run_dir: Path, path: Path, *, task: str | None, **_: Any) -> Path:
    return plot_demonstrations(load_file(run_dir / "demonstrations.safetensors"), path, task=task)


def _actions(run_dir: Path, path: Path, *, task: str | None, **_: Any) -> Path:
    data = load_file(run_dir / "actions.safetensors")
    facts = find_task(task)
    if facts is None:
        return plot_actions(data["predicted"], data["true"], path, names=("x", "y", "z"))
    shown = {"m": "mm", "rad": "mrad"}
    absolute = {name: shown.get(facts.actions[name], "") for name in facts.absolute_actions}
    unit = shown.get(facts.action_unit, facts.action_unit)
    look = {"names": facts.action_names, "unit": unit, "scale": 1e3 if facts.action_unit in shown else 1.0}
    return plot_actions(data["predicted"], data["true"], path, absolute=absolute, **look)


def _eigenvalues(run_dir: Path, path: Path, *, task: str | None, **_: Any) -> Path:
    data = load_file(run_dir / "eigenvalues.safetensors")
    facts = find_task(task)
    hz = facts.control_hz if facts else None
    return plot_eigenvalues(data["real"], data["imag"], path, control_hz=hz)


_TRAIN, _EVAL = "koap train --out {run}", "koap eval {run} --episodes 60 --seed 100"
PICTURES = (
    Picture("rollouts.png", "rollouts.safetensors", _EVAL, _rollouts),
    Picture("rollouts.gif", "rollouts.safetensors", _EVAL, _animation),
    Picture("film.gif", "rollouts.safetensors", _EVAL, _film),
    Picture("modes.png", "rollouts.safetensors", _EVAL, _modes),
    Picture("plans.png", "rollouts.safetensors", _EVAL, _plans),
    Picture("demonstrations.png", "demonstrations.safetensors", _TRAIN, _demonstrations),
    Picture("actions.png", "actions.safetensors", _TRAIN, _actions),
    Picture("losses.png", "metrics.csv", _TRAIN, _losses),
    Picture("eigenvalues.png", "eigenvalues.safetensors", _TRAIN, _eigenvalues),
)
