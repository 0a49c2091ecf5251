# This source code is licensed under the MIT license found in the LICENSE file.
"""Ridge regressions: on raw frames without a latent, and on principal components of unlabelled windows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.modules.inverse_dynamics import InverseDynamics, LatentInverseDynamics
from torchrl_koap.modules.koopman.latent_action import LinearActionDecoder
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.ridge import DEFAULT_PENALTY, INPUT_NOISE, ridge
from torchrl_koap.modules.windows import WindowReader

COUNTS = (2, 4, 8, 16, 32, 64)
MOST_WINDOWS = 4096  # components are computed from fewer than twice as many windows, evenly spaced


class LinearInverseDynamics(InverseDynamics):
    """Predicts the action by ridge regression on the raw frames ``x_{t-n}, ..., x_t, x_{t+k}``, without a latent.

    It is fitted to labelled frames only and needs no training. Args as for
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

    def _read(self, state: Tensor, frames: range | None = None) -> Tensor:
        return self.reader(self.normalize_state(state), frames)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Applies the regression to the frames that are read, standardised."""
        return self.decoder.linear(self.inputs(self._read(state, frames)))

    @torch.no_grad()
    def fit_labels(self, windows: TensorDictBase, mask: Tensor, *, alike: bool = True, **_: Any) -> dict[str, Any]:
        """Fits the regression on the labelled frames."""
        inputs, action, groups = self.labelled_frames(self._read, windows, mask)
        spread = inputs.std(0, correction=0)
        self.inputs.offset.copy_(inputs.mean(0))
        self.inputs.scale.copy_(torch.where(spread > 1e-9, spread, 1.0))
        fit = ridge(self.inputs(inputs), action, groups=groups, input_noise=INPUT_NOISE, alike=alike)
        self.decoder.assign(fit)
        return fit.summary()


class PrincipalInverseDynamics(LatentInverseDynamics):
    """Decodes the leading principal components of a window by ridge regression.

    A window holds the present frame and the scaled steps around it, as for the preset ``semi_supervised``. Components
    are computed from all windows, labelled or not (:meth:`finish`). Held-out errors on labels choose their number: 2,
    4, 8, 16, 32 or 64. Args as for :class:`~torchrl_koap.modules.InverseDynamics`, offsets ``k >= 2``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import PrincipalInverseDynamics
        >>> states = torch.randn(60, 17, 3).cumsum(1)
        >>> model = PrincipalInverseDynamics(3, 2)
        >>> model.prepare(states), model.finish(states)
        (None, None)
        >>> windows = TensorDict({"state": states, "action": (states.roll(-2, 1) - states)[..., :2]}, [60])
        >>> fit = model.fit_labels(windows, torch.ones(60, 17, dtype=torch.bool))
        >>> model(windows.select("state"))["action"].shape
        torch.Size([60, 17, 2])
    """

    basis: Tensor
    gate: Tensor

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        num_past: int = 8,
        look_ahead: Sequence[int] = (2, 3, 4, 5, 6, 7, 8),
        **kwargs,
    ):
        reader = WindowReader(state_dim, num_past=num_past, look_ahead=look_ahead)
        self._counts = tuple(sorted({min(count, reader.num_features) for count in COUNTS}))
        super().__init__(reader, LinearActionDecoder(self._counts[-1], action_dim), **kwargs)
        self.register_buffer("basis", torch.eye(self._counts[-1], reader.num_features))
        self.register_buffer("gate", torch.ones(self._counts[-1]))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Computes the components ``[*B, len(frames), count]`` of windows of raw states; those not chosen are 0."""
        return self.reader(self.normalize_state(state), frames) @ self.basis.mT * self.gate

    def decode(self, latent: Tensor) -> Tensor:
        """Decodes components ``[*B, T, count]`` to actions ``[*B, T, act]`` in normalised units."""
        return self.action_decoder.linear(latent)

    @torch.no_grad()
    def finish(self, windows: Tensor) -> None:
        """Computes the components of windows of raw states ``[N, T, d]``, without labels."""
        windows = windows[:: max(1, len(windows) // MOST_WINDOWS)]
        now = self.reader.num_past
        rows = self.reader(self.normalize_state(windows), range(now, now + 1)).flatten(0, -2).double()
        if rows.shape[0] < rows.shape[1]:
            values, vectors = torch.linalg.eigh(rows @ rows.mT)
            count = min(len(self.basis), len(values))
            found = (vectors[:, -count:].flip(-1).mT @ rows) / values[-count:].flip(0).clamp_min(1e-18).sqrt()[:, None]
        else:
            found = torch.linalg.eigh(rows.mT @ rows)[1][:, -len(self.basis) :].flip(-1).mT
        self.basis.zero_()[: len(found)] = found.to(self.basis)

    @torch.no_grad()
    def fit_labels(self, windows: TensorDictBase, mask: Tensor, *, alike: bool = True, **_: Any) -> dict[str, Any]:
        """Fits the ridge for every number of components and keeps the one with the smallest held-out error."""
        self.gate.fill_(1.0)
        latent, action, groups = self.labelled_frames(self.infer, windows, mask)
        numbers = torch.arange(len(self.gate), device=self.gate.device)
        options = {"groups": groups, "default_penalty": DEFAULT_PENALTY, "input_noise": INPUT_NOISE}
        options |= {"bias": False, "alike": alike}
        fits = {count: ridge(latent * (numbers < count), action, **options) for count in self._counts}
        best = min(fits, key=lambda count: fits[count].error)
        self.gate.copy_(numbers < best)
        self.action_decoder.assign(fits[best])
        return fits[best].summary()
