# This source code is licensed under the MIT license found in the LICENSE file.
"""Losses of the baselines: for predicted actions, and for latents without labels (LAPO, variational auto-encoder)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch

from torchrl_koap.modules.baselines.latents import QuantizedInverseDynamics, VariationalInverseDynamics
from torchrl_koap.modules.inverse_dynamics import InverseDynamics, LatentInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class ActionLoss(WindowLoss):
    """Computes the mean square error of predicted actions, ``loss_action``, over the labelled frames that count.

    A batch without labels gives exactly 0; unlabelled (NaN) actions affect neither value nor gradient.

    Args:
        network (InverseDynamics): the controller.

    Keyword Args:
        freeze_latents (bool): train only the action decoder of a controller with latents, on samples of them
            (:meth:`LatentInverseDynamics.sample`). Defaults to ``False``.
        reduction (str): as for :class:`~torchrl_koap.objectives.base.WindowLoss`.

    Raises:
        ValueError: for ``freeze_latents`` if the network has no latents.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> from torchrl_koap.objectives import ActionLoss
        >>> network = VariationalInverseDynamics(2, 2)
        >>> loss = ActionLoss(network, freeze_latents=True)
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.randn(4, 16, 2),
        ...                     "has_action": torch.ones(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].backward()
        >>> {name.split(".")[0] for name, value in network.named_parameters() if value.grad is not None}
        {'action_decoder'}
    """

    network: InverseDynamics
    out_keys = ["loss_action"]
    required = ("state", "action", "has_action")

    def __init__(self, network: InverseDynamics, *, freeze_latents: bool = False, reduction: str = "mean"):
        super().__init__(network, reduction=reduction)
        if freeze_latents and not isinstance(network, LatentInverseDynamics):
            raise ValueError(f"freeze_latents was asked for, but {type(network).__name__} has no latents")
        self.freeze_latents = freeze_latents

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``, ``action`` and ``has_action``."""
        state, recorded = self._inputs(tensordict)
        network, span = self.network, self.network.valid_frames(state.shape[-2])
        target, counts = self._targets(tensordict, state, recorded, span)
        with self.network_params.to_module(network, preserve_module_state=False):
            if self.freeze_latents:
                predicted = network.decode(network.sample(state, span).detach())
            else:
                predicted = network.predict(state, span)
            error = self._action_error(predicted, target)
        return TensorDict({"loss_action": self._reduce(error, counts)})


class QuantizedDynamicsLoss(WindowLoss):
    r"""Computes the error of the next step, predicted from the past and the code of the transition, ``loss_dynamics``.

    .. math::
        L = \overline{|h_\psi(x_{t-n}, \dots, x_t, u_t) - (x_{t+1} - x_t)|^2}

    with steps divided by their spread, and the mean square over the columns. It reads no labels;
    :class:`~torchrl_koap.objectives.ActionLoss` trains the action decoder afterwards. Args as for
    :class:`~torchrl_koap.objectives.base.WindowLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import QuantizedInverseDynamics
        >>> from torchrl_koap.objectives import QuantizedDynamicsLoss
        >>> loss = QuantizedDynamicsLoss(QuantizedInverseDynamics(2, 2))
        >>> loss(TensorDict({"state": torch.randn(4, 16, 2)}, [4]))["loss_dynamics"].shape
        torch.Size([])
    """

    trains = (QuantizedInverseDynamics,)
    network: QuantizedInverseDynamics
    out_keys = ["loss_dynamics"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``."""
        state, recorded = self._inputs(tensordict)
        span = self.network.valid_frames(state.shape[-2])
        with self.network_params.to_module(self.network, preserve_module_state=False):
            predicted, step = self.network.predict_step(state, span)
            error = (predicted - step).square().mean(-1)
        return TensorDict({"loss_dynamics": self._reduce(error, recorded[..., span.start : span.stop])})


class VariationalLoss(WindowLoss):
    r"""Computes the reconstruction error of each frame's input from sampled latents, and the latents' divergence.

    .. math::
        L = \overline{|g_\psi(u_t) - s_t|^2} + \beta \, \overline{D_{KL}(q(u_t \mid x_{0:T}) \,\|\, N(0, 1))},
        \qquad u_t = \mu_t + \sigma_t \epsilon

    The squared error is averaged over the entries of a reconstruction, at unit scale; the divergence is summed over the
    entries of a latent. It reads no labels; :class:`~torchrl_koap.objectives.ActionLoss` trains the action decoder.

    Args:
        network (VariationalInverseDynamics): the model.

    Keyword Args:
        kl_coeff (float): ``beta``, already applied to ``loss_kl``. Defaults to ``0.01``. Later assignments write to the
            buffer in place.
        reduction (str): as for :class:`~torchrl_koap.objectives.base.WindowLoss`.

    Raises:
        ValueError: if the given noise differs from the latents in shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> from torchrl_koap.objectives import VariationalLoss
        >>> loss = VariationalLoss(VariationalInverseDynamics(2, 2))
        >>> sorted(loss(TensorDict({"state": torch.randn(4, 16, 2)}, [4])).keys())
        ['loss_kl', 'loss_reconstruction']
    """

    @dataclass
    class _AcceptedKeys(WindowLoss._AcceptedKeys):
        """Keys read from the input, as in :class:`WindowLoss`.

        Attributes:
            noise (NestedKey): optional; noise ``[*B, frames, m]`` of the frames that count. Default: random.
        """

        noise: NestedKey = "latent_noise"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    trains = (VariationalInverseDynamics,)
    network: VariationalInverseDynamics
    out_keys = ["loss_reconstruction", "loss_kl"]
    _schedulable_buffers = frozenset({"kl_coeff"})

    def __init__(self, network: VariationalInverseDynamics, *, kl_coeff: float = 0.01, reduction: str = "mean"):
        super().__init__(network, reduction=reduction)
        self.register_coeff_buffer("kl_coeff", float(kl_coeff))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes both terms from ``state``."""
        state, recorded = self._inputs(tensordict)
        span = self.network.valid_frames(state.shape[-2])
        counts = recorded[..., span.start : span.stop]
        with self.network_params.to_module(self.network, preserve_module_state=False):
            read, mean, log_variance = self.network.posterior(state, span)
            noise = self._read_or_draw(tensordict, "noise", mean.shape, lambda: torch.randn_like(mean))
            sample = mean + (0.5 * log_variance).exp() * noise
            error = (self.network.decoder(sample) - read).square().mean(-1)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1)
        losses = {
            "loss_reconstruction": self._reduce(error, counts),
            "loss_kl": self.kl_coeff * self._reduce(divergence, counts),
        }
        return TensorDict(losses)
