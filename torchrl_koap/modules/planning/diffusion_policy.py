# This source code is licensed under the MIT license found in the LICENSE file.
"""Diffusion Policy: a generative model of the next actions given the last observed states, without a plan."""

from __future__ import annotations

from typing import Any

from tensordict import NestedKey
from torch import Tensor, nn

from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.sampler import ConditionalSampler

ACTION_CHUNK = "action_chunk"


class DiffusionPolicy(ConditionalSampler):
    """Samples the next ``horizon`` actions given the last ``history`` states (Chi et al. 2023).

    It models actions as the planner models states, with the same denoiser, noise, solvers and condition. It learns only
    from labelled steps. The first action of a chunk is the one to take *now*, in the last frame of the history::

        frame        0      1      2      3      ...  14          (history = 2, horizon = 14)
                     x_0    x_1
        chunk               a_1    a_2    a_3    ...  a_14        a_t moves x_t to x_{t+1}
        entry               0      1      2      ...  13

    KOAP's first public code diffuses ``a_2, a_3, ...`` here and begins to execute them in frame 1, one step too early.

    Args and other keywords as for :class:`~torchrl_koap.modules.planning.sampler.ConditionalSampler`; a sequence is a
    chunk, of ``act`` columns.

    Keyword Args:
        action_dim (int): number ``act`` of action entries.
        relative (bool): the condition holds displacements from the present state. Defaults to False.
        out_key (NestedKey): the entry of the actions ``[*B, H, act]``. Defaults to ``"action_chunk"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import DiffusionPolicy, TemporalUnet
        >>> policy = DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3, num_steps=4)
        >>> policy.fit_normalizers(torch.randn(100, 16, 2), torch.randn(500, 3))
        >>> policy(TensorDict({"history": torch.randn(5, 2, 2)}, [5]))["action_chunk"].shape
        torch.Size([5, 14, 3])
    """

    def __init__(
        self,
        denoiser: nn.Module,
        *,
        state_dim: int,
        action_dim: int,
        relative: bool = False,
        out_key: NestedKey = ACTION_CHUNK,
        **options: Any,
    ):
        super().__init__(denoiser, state_dim=state_dim, width=action_dim, relative=relative, out_key=out_key, **options)
        self.action_dim = action_dim
        self.action_normalizer = Normalizer(action_dim)

    def fit_normalizers(self, windows: Tensor, actions: Tensor) -> None:
        """Computes the statistics of condition and actions from data, in place, as a planner does.

        Raw states are windows ``[*N, history + horizon, d]``, labelled or not. Raw actions ``[*M, act]`` must be finite
        and in the label budget; all steps of a chunk share their statistics.
        """
        if actions.ndim < 2 or actions.shape[-1] != self.action_dim:
            raise ValueError(f"actions must be [*M, {self.action_dim}] (action_dim), got {list(actions.shape)}")
        history, _ = self.split_window(windows.reshape(-1, *windows.shape[-2:]))
        condition = Normalizer.fit(self.condition(history))
        self.action_normalizer.load_state_dict(Normalizer.fit(actions).state_dict())
        self.condition_normalizer.load_state_dict(condition.state_dict())

    def encode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps raw actions ``[*B, H, act]`` to normalised ones, independently of the history."""
        self.check_sequence(sequence)
        return self.action_normalizer(sequence)

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps normalised actions ``[*B, H, act]`` to raw ones, independently of the history."""
        return self.action_normalizer.inverse(sequence)
