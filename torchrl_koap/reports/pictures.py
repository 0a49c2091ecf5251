# This source code is licensed under the MIT license found in the LICENSE file.
"""The registry of a run's pictures: their sources, their texts, and the functions that draw them.

A picture is one decorated function, here or in any other package::

    @picture("speed.png", source="rollouts.safetensors", title="Speed", caption="Of the tool, per control step.")
    def draw_speed(rollouts, run):
        figure = Figure()
        ...
        return figure

The function is called with the content of its source file and the :class:`~torchrl_koap.reports.run_facts.RunFacts`. It
returns a figure (or a :class:`Film`), which the registry writes atomically in place of an earlier one.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from safetensors import SafetensorError
from safetensors.numpy import load_file

from torchrl_koap.files import read_json, replacing_file
from torchrl_koap.reports.run_facts import RunFacts

FOLDER = "plots"
HOLD_SECONDS = 1.5  # duration of the last frame of a film
_PALETTE_FRAMES = 20  # frames that choose the colours of a film; dots of brief episodes are in some of them only
_BUILT_IN = ("rollout_plots", "demonstrations", "error_plots", "animation", "inspection_plots")
EVAL = "koap eval {run} --episodes 60 --seed 100"
TRAIN = "koap train --out {run}"
_COMMANDS = {
    "rollouts.safetensors": EVAL,
    "eval.json": "koap eval {run}",
    "actions.safetensors": "koap eval {run}",
    "inspect.json": "koap inspect {run}",
}


@dataclass(frozen=True)
class Film:
    """Images ``[height, width, 3]``, uint8, of equal size, each shown for ``seconds``, the last one longer."""

    frames: Iterable[np.ndarray]
    seconds: float


class NothingToDraw(ValueError):
    """The source holds nothing for this picture to show; an earlier picture is removed."""


class NotFilmed(RuntimeError):
    """The film cannot be made here, such as without an OpenGL library; other pictures can be drawn."""


Draw = Callable[[Any, RunFacts], Figure | Film]


@dataclass(frozen=True)
class Picture:
    """A picture of a run: its texts, its source and the function that draws it."""

    name: str  # file name inside ``plots/``
    source: str  # file of the run directory from which it is drawn
    title: str  # its heading in the report
    caption: str | Callable[[RunFacts], str]  # what it shows and how to read it, or a function of the run for this
    draw: Draw  # ``draw(content of the source, run)`` gives a figure or film
    order: int = 1000  # the report shows pictures in this order
    empty: str = ""  # text in the report if the source holds nothing to draw; "": the picture is left out
    offline: bool = False  # only for tasks without an environment, which are evaluated on recorded data

    @property
    def made_by(self) -> str:
        """The command that writes the source; ``{run}`` stands for the directory."""
        return _COMMANDS.get(self.source, TRAIN)

    def caption_for(self, run: RunFacts) -> str:
        """Returns the caption for a run."""
        return self.caption if isinstance(self.caption, str) else self.caption(run)

    def write(self, run: RunFacts) -> None:
        """Draws the picture of a run whose directory holds the source."""
        drawn = self.draw(_load(run.folder / self.source), run)
        save = save_figure if isinstance(drawn, Figure) else save_film
        save(drawn, run.folder / FOLDER / self.name)


_PICTURES: dict[str, Picture] = {}


def picture(name: str, **facts: Any) -> Callable[[Draw], Draw]:
    """Registers the decorated function as the one that draws a picture; ``facts`` are the other fields of `Picture`.

    The function receives a ``.safetensors`` source as a dictionary of arrays, ``.json`` as its content, ``.csv`` as a
    list of rows. It is returned unchanged. Raises a ValueError if the name is taken.
    """

    def register(draw: Draw) -> Draw:
        known = _PICTURES.get(name)
        if known is not None:
            first, second = (f"{item.__module__}.{item.__qualname__}" for item in (known.draw, draw))
            raise ValueError(f"a picture {name!r} is registered already, by {first}; {second} needs another name")
        _PICTURES[name] = Picture(name=name, draw=draw, **facts)
        return draw

    return register


def all_pictures() -> dict[str, Picture]:
    """Returns every registered picture by name, in the order of the report."""
    for module in _BUILT_IN:
        import_module(f"torchrl_koap.reports.{module}")
    return dict(sorted(_PICTURES.items(), key=lambda item: item[1].order))


def draw_pictures(
    folder: str | Path, *, names: Collection[str] | None = None, animation: bool = True
) -> dict[str, str]:
    """Draws every picture whose source exists, or the ``names`` among them, into ``plots/``; continues after failures.

    Animations take some seconds more (``animation``). Returns a message per picture that could not be drawn. It is not
    an error if a source is absent or holds nothing to draw.
    """
    run = RunFacts.read(folder)
    problems = {}
    for item in all_pictures().values():
        if names is not None and item.name not in names:
            continue
        source, path = run.folder / item.source, run.folder / FOLDER / item.name
        if source.exists() and (animation or not item.name.endswith(".gif")):
            try:
                item.write(run)
            except NothingToDraw:
                path.unlink(missing_ok=True)  # an earlier picture shows other data
            except NotFilmed as error:
                problems[item.name] = f"{item.name} was not made: {error}"
            except (ValueError, KeyError, OSError, TypeError, AttributeError, SafetensorError) as error:
                problems[item.name] = f"{item.source}: {error}"
        elif source.exists() and path.exists() and path.stat().st_mtime < source.stat().st_mtime:
            path.unlink()  # this film is of an earlier evaluation
    return problems


def save_figure(figure: Figure, path: str | Path) -> None:
    """Writes a figure as png."""
    with replacing_file(path) as aside:
        figure.savefig(aside, format="png", dpi=150, facecolor="white", metadata={"Software": None})


def save_film(film: Film, path: str | Path) -> None:
    """Writes a film as gif."""
    frames = list(film.frames)
    with replacing_file(path) as aside:
        # one palette for all frames, without dithering: still parts neither flicker nor cost bytes
        some = Image.fromarray(np.concatenate([*frames[:: -(-len(frames) // _PALETTE_FRAMES)], frames[-1]]))
        palette = some.quantize(224, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)  # keeps rare colours
        images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        times = [round(1000 * film.seconds)] * (len(images) - 1) + [round(1000 * HOLD_SECONDS)]
        images[0].save(aside, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0)


def _load(source: Path) -> Any:
    if source.suffix == ".safetensors":
        return load_file(source)
    if source.suffix == ".json":
        return read_json(source)
    with source.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
