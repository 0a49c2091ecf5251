# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap curve``: methods x label budgets x seeds in one command, resumable at any moment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl_koap.commands.command import Command, Options
from torchrl_koap.studies import CurveConfig, run_curve


@dataclass(kw_only=True)
class Curve(Command):
    """Measure success against the number of labels: methods x label fractions x seeds.

    Attributes:
        config: all options.
    """

    config: Options[CurveConfig]

    def __call__(self) -> dict[str, Any]:
        """Does what is missing of the curve and writes its report."""
        return run_curve(self.config)
