# This source code is licensed under the MIT license found in the LICENSE file.
"""Denoising losses, which train the planner on states and the Diffusion Policy on labelled actions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_koap import keys
from torchrl_koap.modules.planning.diffusion_policy import DiffusionPolicy
from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.sampler import ConditionalSampler
from torchrl_koap.objectives.base import NetworkLoss, WindowLoss


class DenoisingLoss(NetworkLoss):
    r"""Computes the mean squared error of a denoiser at random noise levels.

    With a normalised sequence ``x_0``, noise ``eps ~ N(0, I)`` and a random time ``t`` per sequence::

        L = mean | denoiser(signal(t) x_0 + noise(t) eps, t, condition) - x_0 |^2

    A subclass defines how a batch is read (:meth:`read`).

    Args:
        network (ConditionalSampler): network to train, with fitted normalisers.

    Keyword Args:
        create_target_params (bool): keep an averaged copy of the weights in ``target_network_params``, updated by
            :class:`torchrl.objectives.SoftUpdate` and used for sampling. Defaults to True.
        reduction (str): ``"mean"`` | ``"sum"`` | ``"none"`` over the elements ``[*B, H, width]`` that count
            (``"none"``: others are 0). Defaults to ``"mean"``.
        dtype (torch.dtype, optional): dtype of the denoiser's matrix products, such as ``torch.bfloat16``. Default: the
            dtype of its weights.
        weights (Tensor, optional): weights ``[width]`` of the columns in the loss, scaled to a mean of 1. Default:
            equal weights.

    Raises:
        ValueError: for weights of the wrong shape, or that are not positive.
    """

    network: ConditionalSampler
    weights: Tensor | None

    def __init__(
        self,
        network: ConditionalSampler,
        *,
        create_target_params: bool = True,
        reduction: Literal["none", "mean", "sum"] = "mean",
        dtype: torch.dtype | None = None,
        weights: Tensor | None = None,
    ):
        super().__init__(network, create_target_params=create_target_params, reduction=reduction)
        self.dtype = dtype
        if weights is not None:
            if weights.shape != network.noise_shape[1:] or not (weights > 0).all():
                raise ValueError(f"weights must be {list(network.noise_shape[1:])} [width] and positive, got {weights}")
            weights = weights / weights.mean()
        self.register_buffer("weights", weights)

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Reads raw histories ``[*B, h, d]`` and sequences ``[*B, H, width]``, and which of their steps count.

        The steps that count are bool ``[*B, H, 1]``, or None if all count.
        """
        raise NotImplementedError

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss; the input is not changed."""
        network = self.network
        history, sequence, counts = self.read(tensordict)
        with self.network_params.to_module(network, preserve_module_state=False):
            condition = network.encode_history(history)  # with gradient, since features may be trained too
            with torch.no_grad():
                clean = network.encode(history, sequence)
                if counts is not None:  # masking after the network would leave NaN in the gradient
                    clean = torch.where(counts, clean, 0.0)
                noise = self._read_or_draw(tensordict, "noise", clean.shape, lambda: torch.randn_like(clean))
                draw_time = partial(network.schedule.sample_time, clean)
                time = self._read_or_draw(tensordict, "time", clean.shape[:-2], draw_time).to(clean.dtype)
                noisy = network.schedule.add_noise(clean, noise.to(clean.dtype), time)
            with torch.autocast(clean.device.type, self.dtype, enabled=self.dtype is not None):
                predicted = network.denoiser(noisy, time, condition)
            if predicted.shape != clean.shape:  # the difference would broadcast
                raise ValueError(f"the denoiser must return {list(clean.shape)}, got {list(predicted.shape)}")
            error = (predicted - clean).square()  # [*B, H, width]
            if self.weights is not None:
                error = error * self.weights

        result = TensorDict({self.out_keys[0]: self._reduce(error, counts)}, batch_size=[])
        self._clear_weakrefs(tensordict, result, "network_params", "target_network_params")
        return result


class PlannerLoss(DenoisingLoss):
    """Trains a planner on windows of states; Args as for :class:`DenoisingLoss`.

    Plan with the averaged weights as below. Without ``preserve_module_state=False`` they require gradients afterwards,
    and an updater made then raises an error.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_koap.modules import StatePlanner, TemporalUnet
        >>> from torchrl_koap.objectives import PlannerLoss
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> loss = PlannerLoss(planner)
        >>> average = SoftUpdate(loss, eps=0.99)
        >>> loss(TensorDict({"state": torch.randn(8, 16, 2)}, [8]))["loss_planner"].backward()
        >>> average.step()
        >>> with loss.target_network_params.to_module(planner, preserve_module_state=False):
        ...     plan = planner(TensorDict({"history": torch.randn(3, 2, 2)}, [3]))["plan"]
        >>> SoftUpdate(loss, eps=0.99).step()  # an updater made later
    """

    @dataclass
    class _AcceptedKeys:
        """Entries of the input.

        Attributes:
            state (NestedKey): windows of raw states ``[*B, history + horizon, d]``.
            noise (NestedKey): optional noise ``[*B, horizon, d]``. Default: random.
            time (NestedKey): optional time ``[*B]`` in training steps. Default: random.
        """

        state: NestedKey = keys.STATE
        noise: NestedKey = "planner_noise"
        time: NestedKey = "planner_time"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_planner"]
    trains = (StatePlanner,)
    network: StatePlanner

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Reads histories and recorded futures; all steps count (:meth:`DenoisingLoss.read`)."""
        return *self.network.split_window(self._read(tensordict, "state")), None


class DiffusionPolicyLoss(DenoisingLoss):
    """Trains a Diffusion Policy on labelled steps of windows; Args as for :class:`DenoisingLoss`.

    A sequence holds the actions of frames ``history - 1 .. T - 2``. A step counts if it has a label and neither its
    frame nor the next one is padded. For other steps, the denoiser reads the middle of the range of actions plus noise;
    their stored values (NaN) affect neither value nor gradient. A batch without labels gives exactly 0. This method
    learns from labels only: draw windows with ``labelled_share=1`` (:class:`~torchrl_koap.data.WindowSampler`).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import DiffusionPolicy, TemporalUnet
        >>> from torchrl_koap.objectives import DiffusionPolicyLoss
        >>> loss = DiffusionPolicyLoss(DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3))
        >>> batch = TensorDict({"state": torch.randn(8, 16, 2), "action": torch.randn(8, 16, 3),
        ...                     "has_action": torch.ones(8, 16, 1, dtype=torch.bool)}, [8])
        >>> loss(batch)["loss_policy"].backward()
    """

    @dataclass
    class _AcceptedKeys(WindowLoss._AcceptedKeys):
        """Entries of the input, as in :class:`WindowLoss` with ``T = history + horizon``, and two optional ones.

        Attributes:
            noise (NestedKey): noise ``[*B, horizon, act]``. Default: random.
            time (NestedKey): time ``[*B]`` in training steps. Default: random.
        """

        noise: NestedKey = "policy_noise"
        time: NestedKey = "policy_time"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_policy"]
    required = ("state", "action", "has_action")
    trains = (DiffusionPolicy,)
    network: DiffusionPolicy

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Reads histories, actions from the present frame on, and which count (:meth:`DenoisingLoss.read`)."""
        names, now = self.tensor_keys, self.network.history - 1
        state, action = self._read(tensordict, "state"), self._read(tensordict, "action")
        history, _ = self.network.split_window(state)
        wanted = (*state.shape[:-1], self.network.action_dim)
        if action.shape != wanted:
            raise ValueError(f"{names.action!r} must be {list(wanted)} ([*B, T, act]), got {list(action.shape)}")
        labelled = self._read_mask(tensordict, "has_action", state)[..., now:-1]
        counts = labelled & self._recorded(tensordict, state)[..., now:]
        return history, action[..., now:-1, :], counts.unsqueeze(-1)
