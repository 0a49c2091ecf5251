# This source code is licensed under the MIT license found in the LICENSE file.
"""A recurrent network over the time axis; perceptrons are :class:`torchrl.modules.MLP`."""

from __future__ import annotations

from torch import Tensor, nn
from torchrl.modules import LSTM


class SequenceLSTM(nn.Module):
    """One LSTM layer over the time axis from a zero state, then a linear map: ``[*B, T, in] -> [*B, T, out]``.

    TorchRL's python LSTM is used because it traces under :func:`torch.compile`; its weights are those of
    :class:`torch.nn.LSTM`.

    Args:
        in_features (int): columns of the sequence.
        hidden_dim (int): width of the LSTM.
        out_features (int): columns of the output.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.networks import SequenceLSTM
        >>> SequenceLSTM(2, 8, 5)(torch.randn(3, 4, 6, 2)).shape
        torch.Size([3, 4, 6, 5])
    """

    def __init__(self, in_features: int, hidden_dim: int, out_features: int):
        super().__init__()
        self.lstm = LSTM(in_features, hidden_dim, batch_first=True)
        self.readout = nn.Linear(hidden_dim, out_features)

    def forward(self, sequence: Tensor) -> Tensor:
        """Runs the layer over ``[*B, T, in]``."""
        flat = sequence.reshape(-1, *sequence.shape[-2:])
        zeros = flat.new_zeros(1, flat.shape[0], self.lstm.hidden_size)
        out, _ = self.lstm(flat, (zeros, zeros))
        return self.readout(out).reshape(*sequence.shape[:-1], self.readout.out_features)
