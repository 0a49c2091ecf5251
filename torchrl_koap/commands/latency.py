# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap latency``: does a trained policy keep up with its control rate?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import tyro

from torchrl_koap.commands.command import Command, Options
from torchrl_koap.evaluation.latency import LatencyConfig, measure_control_loop


@dataclass(kw_only=True)
class Latency(Command):
    """Run a control loop in real time with a trained policy and count the steps that come too late.

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME.
        config: length and rate of the loop.
    """

    run: tyro.conf.Positional[str]
    config: Options[LatencyConfig]

    def __call__(self) -> dict[str, Any]:
        """Measures."""
        return measure_control_loop(self.run, self.config)
