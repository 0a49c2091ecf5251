# This source code is licensed under the MIT license found in the LICENSE file.
"""A Diffusion Policy in an environment: sample a chunk of actions, execute its beginning, sample again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import MultiStepActorWrapper

from torchrl_koap.keys import ACTION
from torchrl_koap.modules.diffusion.policy import ACTION_CHUNK, DiffusionPolicy
from torchrl_koap.modules.policies.candidates import check_candidates, sample_coherent
from torchrl_koap.modules.policies.plan_then_control import NOISE, OBSERVATION_HISTORY

STATE_HISTORY = "state_history"


class ChunkedPolicy(TensorDictModuleBase):
    """Executes the first ``replan_interval`` actions of every chunk of a :class:`DiffusionPolicy`.

    ::

        step                 0        1        2        3        4
        chunk sampled at     0                                   4
        action               a_0      a_1      a_2      a_3      a'_0

    Every environment of a batch begins a new chunk in its own rhythm, counted from its own reset
    (:class:`torchrl.modules.MultiStepActorWrapper`). Start noise is read from the entry ``"noise"`` if it is there
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
            (:mod:`torchrl_koap.modules.policies.candidates`). Defaults to ``1``.
        choice (str): the rule by which it is taken. Defaults to ``"quarter"``.
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
        choice: str = "quarter",
        history_key: NestedKey = OBSERVATION_HISTORY,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        if history < planner.history:
            raise ValueError(f"the policy reads {planner.history} observed frames, history is only {history}")
        if not 1 <= replan_interval <= planner.horizon:
            raise ValueError(f"replan_interval must be in 1..{planner.horizon} (the horizon), got {replan_interval}")
        columns = None if controller_columns is None else torch.as_tensor(controller_columns)
        self.register_buffer("controller_columns", columns, persistent=False)
        if callable(state_columns):
            self._state_of = state_columns
        else:
            self.register_buffer("state_columns", torch.as_tensor(state_columns), persistent=False)
            self._state_of = self._select
        self.in_keys, self.out_keys = [history_key, "is_init"], [action_key, ACTION_CHUNK]
        self.history, self.replan_interval = history, replan_interval
        check_candidates(candidates, choice)
        self.planner, self.candidates = planner, candidates
        # the rest of a chunk is kept only where the next one is compared with it
        kept = replan_interval if candidates == 1 else planner.horizon
        self.receding = MultiStepActorWrapper(
            _Chunk(planner, replan_interval, kept, candidates, choice),
            n_steps=kept,
            replan_interval=replan_interval,
            action_keys=[action_key],
            chunk_keys=[ACTION_CHUNK],
            init_key="is_init",
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of the current step (and the chunk that the next one continues from)."""
        observed = tensordict.get(self.in_keys[0], None)
        for name, value in ((self.in_keys[0], observed), ("is_init", tensordict.get("is_init", None))):
            if value is None:
                raise KeyError(f"the policy reads {name!r}: append policy_transforms() to the environment")
        if observed.shape[-2] != self.history:
            raise ValueError(
                f"{self.in_keys[0]!r} must hold {self.history} frames on axis -2, got {list(observed.shape)}"
            )
        state = self._state_of(observed[..., -self.planner.history :, :])
        if self.controller_columns is not None:
            state = state[..., self.controller_columns]
        return self.receding(tensordict.set(STATE_HISTORY, state))

    def _select(self, observed: Tensor) -> Tensor:
        return observed[..., self.state_columns]


class _Chunk(TensorDictModuleBase):
    """The part that runs only when a new chunk is due."""

    def __init__(self, planner: DiffusionPolicy, interval: int, kept: int, candidates: int, choice: str):
        super().__init__()
        self.planner, self.interval, self.kept = planner, interval, kept
        self.candidates, self.choice = candidates, choice
        self.in_keys, self.out_keys = [STATE_HISTORY], [ACTION_CHUNK]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        history, noise = tensordict.get(STATE_HISTORY), tensordict.get(NOISE, None)
        if self.candidates == 1:
            actions = self.planner.sample(history, noise)
        else:
            chunk = tensordict.get(ACTION_CHUNK, None)
            actions = sample_coherent(
                self.planner.sample,
                self.planner.action_normalizer,
                history,
                noise,
                number=self.candidates,
                rule=self.choice,
                in_force=None if chunk is None or self.interval == self.kept else chunk[..., self.interval :, :],
                fresh=tensordict.get("is_init").squeeze(-1),
            )
        return tensordict.set(ACTION_CHUNK, actions[..., : self.kept, :])
