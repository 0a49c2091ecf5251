# This source code is licensed under the MIT license found in the LICENSE file.
"""The second stage of controllers with a latent: its action decoder, on the labelled frames."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch

from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class LatentDecoderLoss(WindowLoss):
    """Mean square error of the actions decoded from latents, over the labelled frames that count, ``loss_action``.

    A batch without labels gives exactly 0; an unlabelled (NaN) action reaches neither value nor gradient.

    Args:
        network (LatentInverseDynamics): a :class:`~torchrl_koap.modules.VariationalInverseDynamics`, a
            :class:`~torchrl_koap.modules.QuantizedInverseDynamics`, or another.

    Keyword Args:
        train_encoder (bool): let the gradient reach what infers the latents, as the first public code does. Defaults
            to ``False``: the decoder is fitted to latents that stay as they are.
        samples (bool): decode samples of the latents, of a network with ``sample``, instead of what it infers.
            Defaults to ``False``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, frames]``, 0 where masked).

    Raises:
        ValueError: for samples of a network that has none.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> from torchrl_koap.objectives import LatentDecoderLoss
        >>> network = VariationalInverseDynamics(2, 2)
        >>> loss = LatentDecoderLoss(network)
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.randn(4, 16, 2),
        ...                     "has_action": torch.ones(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].backward()
        >>> {name.split(".")[0] for name, value in network.named_parameters() if value.grad is not None}
        {'action_decoder'}
    """

    network: LatentInverseDynamics
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    out_keys = ["loss_action"]
    uses_labels = True

    def __init__(
        self,
        network: LatentInverseDynamics,
        *,
        train_encoder: bool = False,
        samples: bool = False,
        reduction: str = "mean",
    ):
        super().__init__(network, reduction=reduction)
        if samples and not hasattr(network, "sample"):
            raise ValueError(f"samples were asked for, but {type(network).__name__} has no latents to sample")
        self.samples = samples
        self.train_encoder = train_encoder

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``, ``action`` and ``has_action``."""
        state, recorded = self._inputs(tensordict)
        span = self.network.span(state.shape[-2])
        target, counts = self._targets(tensordict, state, recorded, span)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            latent = (self.network.sample if self.samples else self.network.infer)(state, span)
            latent = latent if self.train_encoder else latent.detach()
            error = self._action_error(self.network.decode(latent), target)
        return TensorDict({"loss_action": self._reduce(error, counts)})
