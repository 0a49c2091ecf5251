# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap train``: demonstrations and a label budget in, a run directory out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl_koap.commands.command import Command, Options, as_typed
from torchrl_koap.training import TrainConfig, train


@dataclass(kw_only=True)
class Train(Command):
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        config: all options.
    """

    config: Options[TrainConfig]

    def __call__(self) -> dict[str, Any]:
        """Trains."""
        return train(self.config, command=as_typed())
