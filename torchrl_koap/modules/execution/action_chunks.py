# This source code is licensed under the MIT license found in the LICENSE file.
"""A Diffusion Policy in an environment: sample a chunk of actions, execute its beginning, sample again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict import NestedKey
from torch import Tensor

from torchrl_koap.keys import ACTION
from torchrl_koap.modules.execution.candidates import sample_coherent
from torchrl_koap.modules.execution.receding_horizon import OBSERVATION_HISTORY, RecedingHorizonPolicy
from torchrl_koap.modules.planning.diffusion_policy import ACTION_CHUNK, DiffusionPolicy


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
        candidates (int): chunks sampled whenever one is due, of which one that goes on with the chunk in force is taken
            (:mod:`torchrl_koap.modules.execution.candidates`). Defaults to ``1``.
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
        candidates: int = 1,
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
            candidates=candidates,
            # the rest of a chunk is kept only where the next one is compared with it
            kept_steps=planner.horizon if candidates > 1 else None,
        )

    def plan_and_decode(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Samples the actions of the next steps.

        Args:
            observations (Tensor): ``[*B, history, obs]``, raw units.
            noise (Tensor): ``[*B, *planner.noise_shape]``, standard normal.

        Returns:
            Tensor: ``[*B, replan_interval, act]``.
        """
        actions = self.planner.sample(self._read(self.state_of(observations)), noise)
        return self.scaled(actions[..., : self.replan_interval, :])

    def make_chunk(
        self, history: Tensor, noise: Tensor | None, in_force: Tensor | None = None, fresh: Tensor | None = None
    ) -> Tensor:
        """Samples actions and keeps those that are executed, or all where the next chunk is compared with them.

        Args:
            history (Tensor): observed states ``[*B, history, d]``, raw units.
            noise (Tensor, optional): ``[*B, *noise_shape]``, standard normal. Default: random.
            in_force (Tensor, optional): the chunk of before ``[*B, H, act]``.
            fresh (Tensor, optional): where an episode begins, bool ``[*B]``.

        Returns:
            Tensor: ``[*B, replan_interval, act]``; ``[*B, H, act]`` for several candidates.
        """
        state = self._read(history)
        if self.candidates == 1:
            return self.planner.sample(state, noise)[..., : self.replan_interval, :]
        left = None if in_force is None else in_force[..., self.replan_interval :, :]
        return sample_coherent(
            self.planner.sample,
            self.planner.action_normalizer,
            state,
            noise,
            number=self.candidates,
            in_force=None if left is None or not left.shape[-2] else left,
            fresh=fresh,
        )

    def _read(self, history: Tensor) -> Tensor:
        """The states that the policy reads, of those observed."""
        state = history[..., -self.planner.history :, :]
        return state if self.controller_columns is None else state[..., self.controller_columns]
