# This source code is licensed under the MIT license found in the LICENSE file.
"""What the denoising losses of planner and Diffusion Policy share: noise, timesteps, masks and reduction."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_koap.modules.diffusion.base import ConditionedDiffusion


class DenoisingLoss(LossModule):
    """Mean squared error of a denoiser at random noise levels; base of the losses of planner and Diffusion Policy.

    A subclass has a ``name``, under which the network, its weights and their average live (``planner``,
    ``planner_params``, ``target_planner_params``), and says what a batch holds (:meth:`read`).

    Args:
        network (ConditionedDiffusion): network to train, its normalisers already fitted.

    Keyword Args:
        create_target_params (bool): keep an averaged copy of the weights, to be moved by
            :class:`torchrl.objectives.SoftUpdate` and used for sampling. Defaults to True.
        reduction (str): ``"mean"`` | ``"sum"`` | ``"none"`` over the elements ``[*B, H, width]`` that count
            (``"none"``: 0 where they do not). Defaults to ``"mean"``.

    Raises:
        ValueError: if ``reduction`` is unknown.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import StatePlanner, TemporalUnet
        >>> from torchrl_koap.objectives import PlannerLoss  # a subclass
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> loss = PlannerLoss(planner, create_target_params=False, reduction="none")
        >>> loss(TensorDict({"state": torch.randn(8, 16, 2)}, [8]))["loss_planner"].shape
        torch.Size([8, 14, 2])
    """

    name: str

    def __init__(
        self,
        network: ConditionedDiffusion,
        *,
        create_target_params: bool = True,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__()
        reduction = "mean" if reduction is None else reduction
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        self.reduction = reduction
        self.convert_to_functional(network, self.name, create_target_params=create_target_params)

    def read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Raw histories ``[*B, h, d]``, raw sequences ``[*B, H, width]``, and which of their steps count.

        The mask is ``[*B, H, 1]``, or None where all do.
        """
        raise NotImplementedError

    def encode(self, history: Tensor, sequence: Tensor, counts: Tensor | None) -> Tensor:
        """The normalised sequences that noise is added to; a subclass says how.

        Args:
            history (Tensor): raw histories ``[*B, h, d]``.
            sequence (Tensor): raw plans or actions ``[*B, H, width]``.
            counts (Tensor, optional): steps that count, bool ``[*B, H, 1]``; None: all.

        Returns:
            Tensor: ``[*B, H, width]``, finite numbers also where steps do not count.
        """
        raise NotImplementedError

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """There is no value estimator."""

    def train(self, mode: bool = True):
        """Sets the mode of the loss, and of the network, which is no submodule of it."""
        super().train(mode)
        getattr(self, self.name).train(mode)
        return self

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that must be there, as renamed by ``set_keys``."""
        return self._entries()

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        raise RuntimeError("in_keys follow the keys of the loss: use set_keys")

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss; the input is not changed."""
        names, network = self.tensor_keys, getattr(self, self.name)
        history, sequence, counts = self.read(tensordict)
        with getattr(self, f"{self.name}_params").to_module(network, preserve_module_state=False):
            with torch.no_grad():
                condition = network.encode_history(history)
                sample = self.encode(history, sequence, counts)
                noise, time = tensordict.get(names.noise, None), tensordict.get(names.time, None)
            error = network.denoising_error(condition, sample, noise, time)  # [*B, H, width]

        result = TensorDict({f"loss_{self.name}": self._reduce(error, counts)}, batch_size=[])
        self._clear_weakrefs(tensordict, result, f"{self.name}_params", f"target_{self.name}_params")
        return result

    def _reduce(self, error: Tensor, counts: Tensor | None) -> Tensor:
        if counts is None:
            return self._reduce_loss(error)
        loss = torch.where(counts, error, 0.0)
        if self.reduction == "none":
            return loss
        return loss.sum() / ((counts.sum() * error.shape[-1]).clamp_min(1) if self.reduction == "mean" else 1)
