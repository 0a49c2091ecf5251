# This source code is licensed under the MIT license found in the LICENSE file.
"""A Diffusion Policy in an environment: sample a chunk of actions, execute its beginning, sample again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict import NestedKey
from torch import Tensor

from torchrl_koap.keys import ACTION
from torchrl_koap.modules.diffusion.policy import ACTION_CHUNK, DiffusionPolicy
from torchrl_koap.modules.policies.receding_horizon import OBSERVATION_HISTORY, RecedingHorizonPolicy


class ChunkedPolicy(RecedingHorizonPolicy):
    """Executes the first ``replan_interval`` actions of every chunk of a :class:`DiffusionPolicy`.

    ::

        step                 0        1        2        3        4
        chunk sampled at     0                                   4
        action               a_0      a_1      a_2      a_3      a'_0

    Every environment of a batch begins a new chunk in its own rhythm, counted from its own reset; batches may have any
    shape. Start noise is read from the entry ``"noise"`` if it is there
    (:class:`~torchrl_koap.modules.EpisodeNoise`). Use it as a
    :class:`~torchrl_koap.modules.PlanThenControl` that needs no controller, in
    :func:`~torchrl_koap.evaluation.rollouts.roll_out` and everywhere else.

    Args:
        planner (DiffusionPolicy): samples actions from the last observed states.

    Keyword Args:
        state_columns (sequence of int, or callable): columns of the observation that make up the state, or a function
            of observations ``[*B, obs]`` that gives it, such as ``get_task("sorting").state_of``.
        history (int): observed frames handed over; the Diffusion Policy reads the last of them.
        replan_interval (int): steps executed per chunk. Defaults to ``4``.
        controller_columns (sequence of int, optional): columns of the state that the Diffusion Policy reads: its mask.
            Default: all.
        history_key (NestedKey): observations ``[*B, history, obs]`` (:func:`~torchrl_koap.modules.policy_transforms`).
        action_key (NestedKey): action of the current step ``[*B, act]``.

    Raises:
        ValueError: for a history shorter than the Diffusion Policy's, or an interval longer than a chunk. At the first
            call for a history of another length.
        KeyError: at the first call, if the environment lacks :func:`~torchrl_koap.modules.policy_transforms`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import ChunkedPolicy, DiffusionPolicy, TemporalUnet
        >>> policy = ChunkedPolicy(
        ...     DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3), state_columns=(2, 3), history=2)
        >>> td = TensorDict({"observation_history": torch.zeros(5, 2, 4),
        ...                  "is_init": torch.ones(5, 1, dtype=torch.bool)}, [5])
        >>> policy(td)["action"].shape
        torch.Size([5, 3])
    """

    def __init__(
        self,
        planner: DiffusionPolicy,
        *,
        state_columns: Sequence[int] | Callable[[Tensor], Tensor],
        history: int,
        replan_interval: int = 4,
        controller_columns: Sequence[int] | None = None,
        history_key: NestedKey = OBSERVATION_HISTORY,
        action_key: NestedKey = ACTION,
    ):
        super().__init__(
            planner,
            state_columns=state_columns,
            history=history,
            replan_interval=replan_interval,
            controller_columns=controller_columns,
            history_key=history_key,
            action_key=action_key,
            cached_key=action_key,
            chunk_key=ACTION_CHUNK,
            reader="policy",
        )

    def plan_and_decode(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Samples the actions of the next steps.

        Args:
            observations (Tensor): ``[*B, history, obs]``, raw units.
            noise (Tensor): ``[*B, *planner.noise_shape]``, standard normal.

        Returns:
            Tensor: ``[*B, replan_interval, act]``.
        """
        return self.make_chunk(self.state_of(observations), noise)

    def make_chunk(self, history: Tensor, noise: Tensor | None) -> Tensor:
        """Samples actions and keeps those that are executed.

        Args:
            history (Tensor): observed states ``[*B, history, d]``, raw units.
            noise (Tensor, optional): ``[*B, *planner.noise_shape]``, standard normal. Default: random.

        Returns:
            Tensor: ``[*B, replan_interval, act]``.
        """
        state = history[..., -self.planner.history :, :]
        if self.controller_columns is not None:
            state = state[..., self.controller_columns]
        return self.planner.sample(state, noise)[..., : self.replan_interval, :]
