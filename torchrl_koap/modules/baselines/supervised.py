# This source code is licensed under the MIT license found in the LICENSE file.
"""Inverse dynamics networks that labels alone teach. A window of states in, an action per frame out."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.windows import WindowReader


class SupervisedInverseDynamics(InverseDynamics):
    r"""Predicts the action of a step from the frames around it by a perceptron, trained on labels.

    .. math::
        a_t = f(x_{t-n}, \dots, x_t, x_{t+k_1}, x_{t+k_2}, \dots)

    With ``look_ahead=1`` this is the inverse dynamics of Decision Diffuser, which is told the next state and nothing
    further ahead. Trained by :class:`~torchrl_koap.objectives.ActionLoss`. Args as for
    :class:`~torchrl_koap.modules.InverseDynamics`, offsets ``k >= 1``, and:

    Keyword Args:
        hidden_dims (sequence of int): widths. Defaults to ``(128, 128)``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import SupervisedInverseDynamics
        >>> model = SupervisedInverseDynamics(2, 2, look_ahead=(1, 4))
        >>> model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))["action"].shape
        torch.Size([3, 16, 2])
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        hidden_dims: Sequence[int] = (128, 128),
        num_past: int = 4,
        look_ahead: int | Sequence[int] = 1,
        **kwargs,
    ):
        super().__init__(WindowReader(state_dim, num_past=num_past, look_ahead=look_ahead, min_offset=1), **kwargs)
        self.network = MLP(self.reader.num_features, action_dim, num_cells=hidden_dims, activation_class=nn.ReLU)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Applies the perceptron to what every frame reads."""
        return self.network(self.reader(self.normalize_state(state), frames))
