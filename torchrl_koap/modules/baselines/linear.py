# This source code is licensed under the MIT license found in the LICENSE file.
"""Ridge regression on raw frames: the control that any latent method must beat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.koopman.action_decoder import LinearActionDecoder
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.ridge import INPUT_NOISE, ridge
from torchrl_koap.modules.windows import WindowReader


class LinearInverseDynamics(InverseDynamics):
    """Predicts the action by ridge regression on the raw frames ``x_{t-n}, ..., x_t, x_{t+k}``, without a latent.

    It reads labelled frames only; there is nothing to train. Args as for
    :class:`~torchrl_koap.modules.InverseDynamics`, offsets ``k >= 2`` as for KOAP.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LinearInverseDynamics
        >>> windows = TensorDict({"state": torch.randn(50, 10, 2)}, [50])
        >>> windows["action"] = windows["state"].roll(-8, 1) - windows["state"]  # x_{t+8} - x_t
        >>> model = LinearInverseDynamics(2, 2)
        >>> fit = model.fit_labels(windows, torch.ones(50, 10, dtype=torch.bool))
        >>> bool((model(windows.clone())["action"][:, 1] - windows["action"][:, 1]).abs().max() < 1e-3)
        True
    """

    def __init__(
        self, state_dim: int, action_dim: int, *, num_past: int = 1, look_ahead: int | Sequence[int] = 8, **kwargs
    ):
        super().__init__(WindowReader(state_dim, num_past=num_past, look_ahead=look_ahead, relative=False), **kwargs)
        self.inputs = Normalizer(self.reader.num_features)
        self.decoder = LinearActionDecoder(self.reader.num_features, action_dim)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Applies the regression to the frames read, at unit spread."""
        return self.decoder.linear(self.inputs(self.reader(self.normalize_state(state), frames)))

    @torch.no_grad()
    def fit_labels(
        self, windows: TensorDictBase, mask: Tensor, *, groups: Tensor | None = None, **_: Any
    ) -> dict[str, Any]:
        """Fits the regression on the labelled frames."""

        def read(state: Tensor, frames: range) -> Tensor:
            return self.reader(self.normalize_state(state), frames)

        inputs, action, groups = self.labelled_frames(read, windows, mask, groups)
        spread = inputs.std(0, correction=0)
        self.inputs.offset.copy_(inputs.mean(0))
        self.inputs.scale.copy_(torch.where(spread > 1e-9, spread, torch.ones_like(spread)))
        fit = ridge(self.inputs(inputs), action, groups=groups, input_noise=INPUT_NOISE)
        self.decoder.assign(fit)
        return fit.summary()
