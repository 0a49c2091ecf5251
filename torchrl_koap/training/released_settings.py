# This source code is licensed under the MIT license found in the LICENSE file.
"""The unequal settings with which KOAP's first public code compares its methods (``--released-settings``).

There every controller has its own architecture, look-ahead, learning rate and dropout, and its updates are counted in
epochs of its own windows: with 2 % of the windows labelled KOAP makes 14 updates in the time in which the supervised
controller makes one. What is taken over: network, learning rate, weight
decay, batch size, warm-up without decay, epochs per task. What is not: early stopping and choice of weights on a
validation set whose labels lie outside the budget, the moving average with a memory of five updates, other
labelled windows for every method, Diffusion Policy's skipped action. The recurrent VAE and FSQ controllers of
that code are not re-expressed here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchrl_koap.data import WindowTable
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import RecurrentInverseDynamics, make_koopman_inverse_dynamics
from torchrl_koap.objectives import InverseDynamicsLoss, KOAPLoss
from torchrl_koap.training.method import Method, Phase
from torchrl_koap.training.methods import METHODS, get_method, without_actions

BATCH_SIZE, WEIGHT_DECAY, WARMUP = 256, 0.01, 200
POLICY_EPOCHS = 200
# of the diffusion policy: 11.95 M parameters, all 50 ancestral steps
POLICY = {"denoiser": "released", "prediction": "epsilon", "solver": "ddpm", "solver_steps": 50, "clip": 1.0}


@dataclass(frozen=True)
class Released:
    """What the first public code does for one method.

    Args:
        method (Method): network and phases.
        learning_rate (float): reached after the warm-up and kept.

    Examples:
        >>> from torchrl_koap.training.released_settings import get_released
        >>> released = get_released("koap")
        >>> released.method.name, released.learning_rate
        ('koap', 0.0003)
    """

    method: Method
    learning_rate: float

    def updates(self, phase: Phase, table: WindowTable, epochs: int) -> int:
        """Updates of a phase: epochs times the batches of an epoch.

        Args:
            phase (Phase): tells which windows it trains on.
            table (WindowTable): the windows.
            epochs (int): passes over them.

        Returns:
            int: at least 1.
        """
        number = int(table.labelled.sum()) if phase.windows == "labelled" else len(table.starts)
        return max(epochs * math.ceil(number / BATCH_SIZE), 1)


def _koap(state_dim, action_dim, normalizers, options):
    return make_koopman_inverse_dynamics(state_dim, action_dim, preset="released", **normalizers)


def _recurrent(state_dim, action_dim, normalizers, options):
    return RecurrentInverseDynamics(state_dim, action_dim, **normalizers)


RELEASED = {
    "koap": Released(Method("koap", "KOAP, first code", _koap, (Phase("controller", KOAPLoss),)), 3e-4),
    "pretrain": Released(
        Method(
            "pretrain",
            "KOAP pre-trained, first code",
            _koap,
            (Phase("controller", without_actions), Phase("finetune", KOAPLoss, "labelled")),
        ),
        3e-4,
    ),
    "dd": Released(
        Method(
            "dd", "supervised LSTM, first code", _recurrent, (Phase("controller", InverseDynamicsLoss, "labelled"),)
        ),
        1e-3,
    ),
    "dp": Released(METHODS["dp"], 1e-4),
}


def get_released(name: str) -> Released:
    """Looks up what the first public code does for a method.

    Raises:
        ValueError: if that code has no such method, or it is not re-expressed here.

    Examples:
        >>> from torchrl_koap.training.released_settings import get_released
        >>> get_released("dd").learning_rate
        0.001
    """
    get_method(name)  # an unknown name is answered with those of all methods
    return lookup(RELEASED, name, "method with released settings:")
