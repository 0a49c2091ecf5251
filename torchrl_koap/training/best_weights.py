# This source code is licensed under the MIT license found in the LICENSE file.
"""Keeps the latest averaged weights whose score on held-out trajectories is near the best one."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from time import perf_counter

import torch
from torch import nn
from torchrl.objectives import LossModule

ROOM = 1.05  # weights up to this factor of the best score are kept: later weights follow plans more exactly
PATIENCE = 1.5  # training ends after this many times the updates of the kept weights


class BestWeights(nn.Module):
    """Scores the averaged weights of a loss at intervals; keeps the latest ones within 5 % of the best score.

    Its state dict holds everything that a resumed training needs.

    Args:
        loss (LossModule): a loss of ``network`` with ``target_network_params``.
        score (callable): ``score(network)`` on held-out trajectories; smaller is better.
        every (int): updates between two scores.
    """

    best: torch.Tensor
    step: torch.Tensor
    seconds: torch.Tensor

    def __init__(self, loss: LossModule, score: Callable[[nn.Module], float], every: int):
        super().__init__()
        self._loss, self._score = (loss,), score  # a tuple, so that the loss is not registered as a submodule
        self._now = (copy.deepcopy(loss.network),)
        self.network = copy.deepcopy(loss.network)
        self.every = every
        self.register_buffer("best", torch.tensor(math.inf, dtype=torch.float64))
        self.register_buffer("step", torch.tensor(0))
        self.register_buffer("seconds", torch.tensor(0.0, dtype=torch.float64))  # spent on scores, in resumed runs too

    def check(self, step: int) -> dict[str, float]:
        """Scores the averaged weights after ``step`` updates, keeps good ones; returns the score and :meth:`kept`."""
        began, (loss,), (now,) = perf_counter(), self._loss, self._now
        now.load_state_dict(loss.target_network_params.flatten_keys(".").to_dict())
        score = self._score(now)
        if score < ROOM * self.best or not self.best.isfinite():  # the score is not finite if nothing moves
            self.network.load_state_dict(now.state_dict())
            self.best.fill_(min(score, self.best.item()))
            self.step.fill_(step)
        self.seconds += perf_counter() - began
        return {"held_out_score": score} | self.kept()

    def kept(self) -> dict[str, float]:
        """Returns the best score, and the update at which the kept weights were scored."""
        return {"best_held_out_score": self.best.item(), "kept_update": self.step.item()}

    def finished(self, step: int) -> bool:
        """Returns whether training should end after ``step`` updates, as no better score is expected."""
        return step >= PATIENCE * self.step.item() + 4 * self.every
