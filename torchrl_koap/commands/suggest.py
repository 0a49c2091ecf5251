# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap suggest``: which demonstrations a person should label next."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from torchrl_koap.commands.command import Command, Options
from torchrl_koap.evaluation import SuggestConfig, SuggestedLabels, suggest
from torchrl_koap.runs.run_directory import RunDirectory


@dataclass(kw_only=True)
class Suggest(Command):
    """Say which unlabelled demonstrations of a trained run to label next; no label outside the budget is read.

    Attributes:
        run: run directory of `koap train`.
        config: all options.
    """

    run: tyro.conf.Positional[Path]
    config: Options[SuggestConfig]

    def __call__(self) -> SuggestedLabels:
        """Ranks the unlabelled demonstrations and writes ``suggestions.json``."""
        found = suggest(self.run, self.config)
        RunDirectory(self.run).write_json("suggestions.json", asdict(found))
        return found
