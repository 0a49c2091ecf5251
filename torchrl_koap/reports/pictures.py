# This source code is licensed under the MIT license found in the LICENSE file.
"""The register of a run's pictures: what each is drawn from, what it shows, and which function draws it.

A picture is one decorated function, here or in any other package::

    @picture("speed.png", source="rollouts.safetensors", title="Speed", caption="Of the tool, per control step.")
    def plot_speed(rollouts, path, *, control_hz):
        ...

The function is called with the content of its source file and the path to write, and with those of the facts about the
run (see :data:`FACTS`) that it names as keyword arguments.
"""

from __future__ import annotations

import csv
import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.numpy import load_file

from torchrl_koap.tasks import task_of

FOLDER = "plots"
FACTS = {
    "task": "name of the run's task, None where its scene cannot be drawn",
    "num_modes": "number of modes of the task",
    "control_hz": "control steps per second, None where unknown",
    "actions": "name, unit and whether it is absolute of every action column, None where unknown",
    "columns": "name and unit of every state column of a task without an environment, None for others",
    "run_dir": "the run directory",
}
_BUILT_IN = (
    "rollout_plots",
    "demonstration_plot",
    "offline_plots",
    "animation",
    "mode_plots",
    "training_plots",
    "latent_plot",
    "diagnosis_plot",
)
_MOVING = (".gif", ".mp4")


class NothingToDraw(ValueError):
    """The source holds nothing that this picture could show; an earlier picture is removed."""


class NotFilmed(RuntimeError):
    """No OpenGL library can be used here; everything else can be drawn."""


@dataclass(frozen=True)
class Picture:
    """One picture of a run.

    Args:
        name (str): file name inside ``plots/``.
        source (str): file of the run directory it is drawn from.
        title (str): its heading in the report.
        caption (str): what it shows and how to read it.
        draw (callable): called with the content of the source and the path, and the facts it names.
        command (str): the ``koap`` command that leaves the source, ``{run}`` stands for the directory.
        place (int): pictures stand in the report in this order.
        caption_of (callable, optional): from the name of a task (or None) to a further sentence of the caption.
        empty (str): what the report says where the source holds nothing to draw; nothing if it is empty.
        recorded (bool): it is of tasks without an environment alone, which are judged on recorded data.

    Examples:
        >>> from torchrl_koap.reports.pictures import all_pictures
        >>> picture = all_pictures()["rollouts.png"]
        >>> picture.source, picture.caption_for() == picture.caption
        ('rollouts.safetensors', True)
    """

    name: str
    source: str
    title: str
    caption: str
    draw: Callable[..., Path | None]
    command: str = "koap train --out {run}"
    place: int = 1000
    caption_of: Callable[[str | None], str] | None = None
    empty: str = ""
    recorded: bool = False

    def caption_for(self, task: str | None = None) -> str:
        """The caption, with what it adds for a task."""
        return self.caption + (self.caption_of(task) if self.caption_of else "")


_PICTURES: dict[str, Picture] = {}
_COMMANDS = {
    "rollouts.safetensors": "koap eval {run} --episodes 60 --seed 100",
    "inspect.json": "koap inspect {run}",
}


def picture(
    name: str,
    *,
    source: str,
    title: str,
    caption: str,
    command: str | None = None,
    place: int = 1000,
    caption_of: Callable[[str | None], str] | None = None,
    empty: str = "",
    recorded: bool = False,
) -> Callable[[Callable[..., Path | None]], Callable[..., Path | None]]:
    """Registers the decorated function as the one that draws a picture of a run; the function stays as it is.

    Args:
        name (str): file name inside ``plots/``, with its ending.
        source (str): file of the run directory that is read: ``.safetensors`` comes as a dictionary of arrays,
            ``.json`` as what it holds, ``.csv`` as a list of rows.

    Keyword Args:
        title (str): heading in the report.
        caption (str): what the picture shows and how to read it.
        command (str, optional): the ``koap`` command that leaves the source. Default: the one known for that file.
        place (int): rank in the report; those of equal rank keep the order of their registration.
        caption_of (callable, optional): a further sentence of the caption for a task.
        empty (str): what the report says where the source holds nothing to draw.
        recorded (bool): it is of tasks without an environment alone.

    Raises:
        ValueError: if there is a picture of that name already, or a fact is asked for that does not exist.

    Examples:
        >>> from torchrl_koap.reports.pictures import all_pictures, picture
        >>> @picture("speed.png", source="rollouts.safetensors", title="Speed", caption="Of the tool.")
        ... def plot_speed(rollouts, path): ...
        >>> all_pictures()["speed.png"].command
        'koap eval {run} --episodes 60 --seed 100'
        >>> del _PICTURES["speed.png"]
    """

    def register(draw: Callable[..., Path | None]) -> Callable[..., Path | None]:
        known = _PICTURES.get(name)
        where = f"{draw.__module__}.{draw.__qualname__}"
        if known is not None:
            first = f"{known.draw.__module__}.{known.draw.__qualname__}"
            raise ValueError(f"a picture {name!r} is registered already, by {first}; {where} needs another name")
        for key, parameter in _facts_of(draw):
            if key not in FACTS and parameter.default is parameter.empty:
                raise ValueError(f"picture {name!r}: {where} wants {key!r}, there are only {', '.join(FACTS)}")
        usual = command or _COMMANDS.get(source, "koap train --out {run}")
        _PICTURES[name] = Picture(name, source, title, caption, draw, usual, place, caption_of, empty, recorded)
        return draw

    return register


def all_pictures() -> dict[str, Picture]:
    """Every registered picture by name, in the order of the report.

    Examples:
        >>> from torchrl_koap.reports.pictures import all_pictures
        >>> list(all_pictures())[0], "cylinders" in all_pictures()["rollouts.png"].caption_for("avoiding")
        ('rollouts.png', True)
    """
    for module in _BUILT_IN:
        import_module(f"torchrl_koap.reports.{module}")
    return dict(sorted(_PICTURES.items(), key=lambda item: item[1].place))


def draw_pictures(
    run_dir: str | Path, *, animation: bool = True, progress: Callable[[int, int], None] | None = None
) -> dict[str, str]:
    r"""Draws every picture whose source is there into ``plots/``; one that fails does not stop the others.

    Args:
        run_dir (str or Path): the run directory.
        animation (bool): draw the moving pictures too (a second from above, some more for the film).
        progress (callable, optional): called with (pictures looked at, pictures in all).

    Returns:
        dict: what went wrong, a message per picture that could not be drawn although its source is there. A picture
        whose source is absent, or holds nothing to draw, is not an error.

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
    facts, wanted, problems = run_facts(run_dir), all_pictures(), {}
    for number, (name, item) in enumerate(wanted.items()):
        if (run_dir / item.source).exists() and (animation or not name.endswith(_MOVING)):
            try:
                draw_picture(item, run_dir, facts)
            except NothingToDraw:
                (run_dir / FOLDER / name).unlink(missing_ok=True)  # an earlier picture shows other data
            except NotFilmed as error:
                problems[name] = f"{name} was not made: {error}"
            except (ValueError, KeyError, OSError, TypeError, SafetensorError) as error:
                problems[name] = f"{item.source}: {error}"
        elif (film := run_dir / FOLDER / name).exists() and _is_older(film, run_dir / item.source):
            film.unlink()  # a film of an earlier evaluation beside the figures of this one
        if progress is not None:
            progress(number + 1, len(wanted))
    return problems


def draw_picture(item: Picture, run_dir: Path, facts: Mapping[str, Any] | None = None) -> Path:
    """Draws a single picture of a run.

    Args:
        item (Picture): the picture.
        run_dir (Path): the run directory, which holds its source.
        facts (mapping, optional): of :func:`run_facts`; read from the directory if not given.

    Returns:
        Path: the file.
    """
    facts = run_facts(run_dir) if facts is None else facts
    path = run_dir / FOLDER / item.name
    asked = {
        key: facts[key]
        for key, parameter in _facts_of(item.draw)
        if key in facts and (facts[key] is not None or key == "task" or parameter.default is parameter.empty)
    }
    content = _load(run_dir / item.source)
    path.parent.mkdir(parents=True, exist_ok=True)
    item.draw(content, path, **asked)
    return path


def run_facts(run_dir: Path) -> dict[str, Any]:
    """What is known about a run beside its sources: :data:`FACTS` as keyword arguments of the pictures.

    Args:
        run_dir (Path): the run directory; ``config.json`` is read if it is there.
    """
    try:
        task = task_of(json.loads((run_dir / "config.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # a run of a task that nobody knows here
        task = None
    columns, offline = None, task is not None and task.env is None
    if task is not None:
        columns = [(name, action.unit, action.kind != "delta") for name, action in task.actions.items()]
    return {
        "task": task.name if task else None,
        "num_modes": task.num_modes if task else 24,
        "control_hz": task.control_hz if task else None,
        "actions": columns,
        "columns": list(zip(task.state_names, task.state_units, strict=True)) if offline else None,
        "run_dir": run_dir,
    }


def _facts_of(draw: Callable) -> list[tuple[str, inspect.Parameter]]:
    parameters = inspect.signature(draw).parameters
    return [(key, part) for key, part in parameters.items() if part.kind is part.KEYWORD_ONLY]


def _load(source: Path) -> Any:
    if source.suffix == ".safetensors":
        return load_file(source)
    if source.suffix == ".json":
        return json.loads(source.read_text(encoding="utf-8"))
    with source.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _is_older(film: Path, source: Path) -> bool:
    """Whether a film was made before what it shows was written (again)."""
    return source.exists() and film.stat().st_mtime < source.stat().st_mtime
