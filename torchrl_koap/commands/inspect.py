# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap inspect``: which part of a trained run fails, what its latent actions hold; drawn and written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import tyro

from torchrl_koap.commands.command import Command, Options
from torchrl_koap.evaluation import InspectConfig, inspect
from torchrl_koap.reports.pictures import draw_pictures
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.runs.run_directory import RunDirectory


@dataclass(kw_only=True)
class Inspect(Command):
    """Find out which part of a trained run fails, and what its latent actions hold.

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME.
        config: all options.
    """

    run: tyro.conf.Positional[str]
    config: Options[InspectConfig]

    def __call__(self) -> dict[str, Any]:
        """Inspects, draws, and writes ``inspect.json``."""
        found = inspect(self.run, self.config)
        result, folder = found.result, found.folder
        RunDirectory(folder).write_json("inspect.json", result)
        draw_pictures(folder, names=("inspect.png", "latent.png"))
        if (folder / "index.html").exists():
            write_report(folder, draw=False)
        return result
