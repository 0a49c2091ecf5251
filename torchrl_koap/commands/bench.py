# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap bench``: the comparisons of the paper as presets of ``koap curve``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl_koap.commands.command import Command, Options
from torchrl_koap.studies import BenchConfig, run_bench


@dataclass(kw_only=True)
class Bench(Command):
    """Reproduce a comparison of the paper: a curve per task, and one report over all.

    Attributes:
        config: all options.
    """

    config: Options[BenchConfig]

    def __call__(self) -> dict[str, Any]:
        """Does what is missing of the comparison and writes its report."""
        return run_bench(self.config)
