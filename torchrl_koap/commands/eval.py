# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap eval``: a trained run scored with intervals in closed loop, or on recorded data, and its report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.commands.command import Command, Options
from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.offline import KIND, describe_offline
from torchrl_koap.reports.run_report import write_report
from torchrl_koap.runs.progress import check_logger, log_scores, open_logger


@dataclass(kw_only=True)
class Eval(Command):
    """Evaluate a trained run, in closed loop or, without an environment, on recorded data, and write its report.

    Attributes:
        run: run directory of `koap train`, or pretrained:NAME, a trained policy of the repository.
        config: all options of the rollouts.
        report: draw the pictures and write the report.
        animate: make an animation of the rollouts for the report.
        logger: where scores go besides the run directory: wandb (offline unless WANDB_MODE says otherwise) or
            tensorboard; each needs its extra.
    """

    run: tyro.conf.Positional[str]
    config: Options[EvalConfig]
    report: bool = True
    animate: bool = True
    logger: str = "csv"

    def __call__(self) -> dict[str, Any] | str:
        """Evaluates and reports; the figures of an evaluation without an environment come in words."""
        check_logger(self.logger)
        result = evaluate(self.run, self.config)
        folder = Path(self.run) if self.config.out is None else self.config.out
        if self.report:
            write_report(folder, animation=self.animate)
        with open_logger(self.logger, folder) as logger:
            if logger is not None:
                log_scores(logger, result)
        return describe_offline(result) if result.get("kind") == KIND else result
