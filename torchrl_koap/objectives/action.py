# This source code is licensed under the MIT license found in the LICENSE file.
"""The loss of predicted actions: of supervised inverse dynamics, and of the second stage of those with a latent."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch

from torchrl_koap.modules.inverse_dynamics import InverseDynamics, LatentInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class ActionLoss(WindowLoss):
    """Computes the mean square error of predicted actions, ``loss_action``, over the labelled frames that count.

    A batch without labels gives exactly 0; an unlabelled (NaN) action reaches neither value nor gradient.

    Args:
        network (InverseDynamics): the controller.

    Keyword Args:
        freeze_latents (bool): fit the action decoder of a controller with a latent to latents that stay as they are.
            Defaults to ``False``.
        sample (bool): decode samples of the latents instead of what is inferred. Defaults to ``False``.
        reduction (str): as for :class:`~torchrl_koap.objectives.base.WindowLoss`.

    Raises:
        ValueError: for latents to freeze, or samples, of a network that has none.

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

    def __init__(
        self, network: InverseDynamics, *, freeze_latents: bool = False, sample: bool = False, reduction: str = "mean"
    ):
        super().__init__(network, reduction=reduction)
        latent, kind = isinstance(network, LatentInverseDynamics), type(network).__name__
        if freeze_latents and not latent:
            raise ValueError(f"freeze_latents was asked for, but {kind} has no latents")
        if sample and not (latent and network.samples_latents):
            raise ValueError(f"samples were asked for, but {kind} has no latents to sample")
        self.freeze_latents, self.sample = freeze_latents, sample

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``, ``action`` and ``has_action``."""
        state, recorded = self._inputs(tensordict)
        network, span = self.network, self.network.valid_frames(state.shape[-2])
        target, counts = self._targets(tensordict, state, recorded, span)
        with self.network_params.to_module(network, preserve_module_state=False):
            if self.freeze_latents or self.sample:
                latent = (network.sample if self.sample else network.infer)(state, span)
                predicted = network.decode(latent.detach() if self.freeze_latents else latent)
            else:
                predicted = network.predict(state, span)
            error = self._action_error(predicted, target)
        return TensorDict({"loss_action": self._reduce(error, counts)})
