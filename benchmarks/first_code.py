# This source code is licensed under the MIT license found in the LICENSE file.
"""Registers the networks of KOAP's first public code as two methods (docs/variants.md).

    PYTHONPATH=benchmarks koap train --plugin first_code --method first_code --dataset DIR --out runs/first_code

``first_code`` is KOAP with a recurrent lifting, a feed-forward ``f`` on raw frames with dropout and a diagonal
operator, its decoder trained by gradients; ``first_code_dd`` is the supervised LSTM. Other properties of that code are
not reproduced: learning rates, epochs over each method's own windows, selection on validation labels.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import LSTM, MLP

from torchrl_koap.modules import (
    InverseDynamics,
    KoopmanInverseDynamics,
    KoopmanLifting,
    KoopmanOperator,
    LatentActionModule,
    LinearActionDecoder,
)
from torchrl_koap.objectives import ActionLoss, KOAPLoss
from torchrl_koap.training import Method, Phase, register_method

LATENT_DIM, HIDDEN_DIM, DROPOUT = 512, 256, 0.1


class SequenceLSTM(nn.Module):
    """Applies one LSTM layer over time from a zero state, then a linear map: ``[*B, T, in] -> [*B, T, out]``.

    Args:
        in_features (int): columns of the sequence.
        out_features (int): columns of the output.
        hidden_dim (int): width of the LSTM.
    """

    def __init__(self, in_features: int, out_features: int, hidden_dim: int = HIDDEN_DIM):
        super().__init__()
        self.lstm = LSTM(in_features, hidden_dim, batch_first=True)
        self.readout = nn.Linear(hidden_dim, out_features)

    def forward(self, sequence: Tensor) -> Tensor:
        """Applies the layers to ``[*B, T, in]``."""
        flat = sequence.reshape(-1, *sequence.shape[-2:])
        zeros = flat.new_zeros(1, flat.shape[0], self.lstm.hidden_size)
        out, _ = self.lstm(flat, (zeros, zeros))
        return self.readout(out).reshape(*sequence.shape[:-1], self.readout.out_features)


class RecurrentLifting(KoopmanLifting):
    """Lifts by an LSTM over the window, so that ``z_t`` depends on ``x_0..x_t``; another LSTM maps back.

    Args:
        state_dim (int): size ``d`` of a state.
        latent_dim (int): size ``m`` of a lifted state.
    """

    def __init__(self, state_dim: int, latent_dim: int):
        super().__init__(state_dim, latent_dim, hidden_dims=())
        self.encoder, self.decoder = SequenceLSTM(state_dim, latent_dim), SequenceLSTM(latent_dim, state_dim)


class DiagonalOperator(KoopmanOperator):
    """Multiplies lifted states entry by entry with real numbers, drawn from a normal distribution.

    Args:
        latent_dim (int): size ``m`` of a lifted state.
    """

    def __init__(self, latent_dim: int):
        super().__init__(latent_dim)
        self.weight = nn.Parameter(torch.randn(latent_dim))

    def reset_parameters(self) -> None:
        """Redraws the numbers."""
        nn.init.normal_(self.weight)

    def eigenvalues(self) -> Tensor:
        """Returns the numbers, complex ``[m]``, largest modulus first."""
        values = self.weight.detach()
        return torch.complex(values, torch.zeros_like(values))[values.abs().argsort(descending=True)]

    def step(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Computes ``k z + u`` for lifted states and latent actions ``[*B, T, m]``."""
        return lifted * self.weight + latent_action


class FeedForwardAction(LatentActionModule):
    """Infers latent actions from the raw frames ``x_{t-1}, x_t, x_{t+7}`` by a perceptron with dropout.

    Args:
        state_dim (int): size ``d`` of a state.
        latent_dim (int): size ``m`` of a latent action.
    """

    def __init__(self, state_dim: int, latent_dim: int):
        super().__init__(state_dim, latent_dim, num_past=1, look_ahead=7, clamped=True)
        widths = (HIDDEN_DIM, HIDDEN_DIM)
        size = self.reader.num_features
        self.network = MLP(size, latent_dim, num_cells=widths, activation_class=nn.ReLU, dropout=DROPOUT)

    def infer(self, read: Tensor) -> Tensor:
        """Applies the perceptron to frames ``[*B, T, 3, d]``."""
        return self.network(read.flatten(-2))


class RecurrentInverseDynamics(InverseDynamics):
    """Predicts ``a_t`` from ``x_0, ..., x_{t+1}`` by an LSTM; the last frame repeats the action of the previous one.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.
        **kwargs: columns, normalisers and keys, see :class:`~torchrl_koap.modules.InverseDynamics`.
    """

    num_past, num_window_frames = 1, 3

    def __init__(self, state_dim: int, action_dim: int, **kwargs):
        super().__init__(**kwargs)
        self.network = SequenceLSTM(state_dim, action_dim)

    def valid_frames(self, num_frames: int) -> range:
        """Returns all frames but the first and the last."""
        return range(1, num_frames - 1)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Predicts normalised actions ``[*B, len(frames), act]`` of a window of raw states ``[*B, T, d]``."""
        action = self.network(self.normalize_state(state))[..., 1:, :]
        action = torch.cat([action, action[..., -1:, :]], -2)
        return action if frames is None else action[..., frames.start : frames.stop, :]


def build(task, columns, normalizers, preset):
    """Builds KOAP as in the first public code."""
    return KoopmanInverseDynamics(
        FeedForwardAction(len(columns), LATENT_DIM),
        LinearActionDecoder(LATENT_DIM, task.action_dim),
        lifting=RecurrentLifting(len(columns), LATENT_DIM),
        operator=DiagonalOperator(LATENT_DIM),
        **normalizers,
    )


def build_supervised(task, columns, normalizers, preset):
    """Builds the supervised LSTM of the first public code."""
    return RecurrentInverseDynamics(len(columns), task.action_dim, **normalizers)


# preset "paper": the first code normalises states and actions by their range, as the paper does
register_method(
    Method("first_code", "KOAP, first public code", build, (Phase("controller", KOAPLoss),), presets=("paper",))
)
register_method(
    Method(
        "first_code_dd",
        "supervised LSTM, first public code",
        build_supervised,
        (Phase("controller", ActionLoss, "labelled"),),
        presets=("paper",),
    )
)
