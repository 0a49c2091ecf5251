# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner: a generative model of the next states given the last observed ones. It reads no actions."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from torch import Tensor, nn

from torchrl_koap import keys
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.sampler import ConditionalSampler


class StatePlanner(ConditionalSampler):
    """Samples the next ``horizon`` states given the last ``history`` ones: KOAP's pi_PL(x_{t+1:t+H} | x_{t-h+1:t}).

    With ``relative=True`` a plan is modelled as displacements from the present state, and the condition is the
    displacement of the older frames together with the present state itself::

        frame        0      1       2      3          (history = 2)
                     x_0    x_1     x_2    x_3
        condition    x_0-x_1, x_1
        plan                        x_2-x_1, x_3-x_1, ...

    Every entry of condition and plan has its own offset and scale (:meth:`fit_normalizers`), part of the state dict.
    Conditions are scaled by their range, plans by their spread while they move (``"moving"`` of
    :meth:`Normalizer.fit`). Scaled by range, first frames would be a tenth as wide as last ones, and the noise of the
    schedule would hide them. Scaled by standard deviation, an object that rarely moves would dominate the loss.

    Args and other keywords as for :class:`~torchrl_koap.modules.planning.sampler.ConditionalSampler`; a sequence is a
    plan, of ``d`` columns.

    Keyword Args:
        relative (bool): model displacements from the present state. Defaults to True.
        out_key (NestedKey): the entry of the plan ``[*B, H, d]``. Defaults to ``"plan"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import StatePlanner, TemporalUnet
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2, num_steps=4)
        >>> windows = torch.randn(100, 16, 2).cumsum(1)
        >>> planner.fit_normalizers(windows)
        >>> planner(TensorDict({"history": windows[:5, :2]}, [5]))["plan"].shape
        torch.Size([5, 14, 2])
    """

    def __init__(
        self,
        denoiser: nn.Module,
        *,
        state_dim: int,
        relative: bool = True,
        out_key: NestedKey = keys.PLAN,
        **options: Any,
    ):
        super().__init__(denoiser, state_dim=state_dim, width=state_dim, relative=relative, out_key=out_key, **options)
        self.plan_normalizer = Normalizer(self.horizon * state_dim)

    def fit_normalizers(self, windows: Tensor) -> None:
        """Computes the statistics of condition and plan from data, in place.

        Call it before building ``SoftUpdate``, which copies statistics to the averaged weights only then. A loss may be
        built earlier. Raw states are windows ``[*N, history + horizon, d]``, padded as in training; otherwise padded
        plans in training, which stand still, are far outside the range of the network.
        """
        history, plan = self.split_window(windows.reshape(-1, *windows.shape[-2:]))
        self.condition_normalizer.load_state_dict(Normalizer.fit(self.condition(history)).state_dict())
        self.plan_normalizer.load_state_dict(Normalizer.fit(self._displaced(history, plan), mode="moving").state_dict())

    def encode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps raw plans ``[*B, H, d]`` to normalised sequences (:meth:`ConditionalSampler.encode`)."""
        self.check_sequence(sequence)
        return self.plan_normalizer(self._displaced(history, sequence)).unflatten(-1, self.noise_shape)

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps normalised sequences ``[*B, H, d]`` to raw plans (:meth:`ConditionalSampler.decode`)."""
        plan = self.plan_normalizer.inverse(sequence.flatten(-2)).unflatten(-1, self.noise_shape)
        return plan + history[..., -1:, :] if self.relative else plan

    def _displaced(self, history: Tensor, plan: Tensor) -> Tensor:
        """Returns raw plans as they are modelled (``relative``), flattened to ``[*B, H * d]``."""
        return (plan - history[..., -1:, :] if self.relative else plan).flatten(-2)
