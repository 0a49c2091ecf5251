# This source code is licensed under the MIT license found in the LICENSE file.
"""Receding-horizon control: a chunk is made every few steps, handed out step by step, then made anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.transforms import CatFrames, Compose, InitTracker, UnsqueezeTransform
from torchrl.modules import MultiStepActorWrapper

from torchrl_koap.keys import ACTION, OBSERVATION
from torchrl_koap.modules.execution.candidates import check_candidates

if TYPE_CHECKING:
    from torchrl_koap.modules.execution.command_leash import CommandLeash

OBSERVATION_HISTORY = "observation_history"
STATE_HISTORY = "state_history"
IS_INIT = "is_init"


def policy_transforms(
    history: int, *, observation_key: NestedKey = OBSERVATION, history_key: NestedKey = OBSERVATION_HISTORY
) -> Compose:
    """Environment transforms that the policies need: ``is_init`` and the last ``history`` observations.

    At the start of an episode the first observation is repeated.

    Args:
        history (int): observed frames, the present one included.

    Keyword Args:
        observation_key (NestedKey): entry of the observation ``[*B, obs]``. Defaults to ``"observation"``.
        history_key (NestedKey): entry that the policy reads, its ``in_keys[0]``. Defaults to
            ``"observation_history"``.

    Returns:
        Compose: transforms for a ``TransformedEnv``.

    Examples:
        >>> from torchrl_koap.modules import policy_transforms
        >>> len(policy_transforms(5))
        3
    """
    return Compose(
        InitTracker(),
        UnsqueezeTransform(-2, in_keys=[observation_key], out_keys=[history_key]),
        CatFrames(N=history, dim=-2, in_keys=[history_key], out_keys=[history_key]),
    )


class RecedingHorizonPolicy(TensorDictModuleBase):
    """Base of the policies: a subclass makes chunks (:meth:`make_chunk`) and may decode their entries (:meth:`act`).

    Every environment of a batch begins a new chunk in its own rhythm, counted from its own reset
    (:class:`torchrl.modules.MultiStepActorWrapper`, which wants one batch dimension: batches of any other shape, ``[]``
    of a single environment included, are flattened around it). What is in force travels in the tensordict; where it is
    lost on the way (a :class:`torchrl.envs.ParallelEnv` whose workers reset by themselves hands on its own entries
    alone), the policy remembers what it wrote last.

    Args:
        planner (nn.Module): samples what chunks are made of; has ``history``, ``horizon`` and ``noise_key``, the entry
            that is handed to it if it is there.

    Keyword Args:
        state_columns (sequence of int, or callable): columns of the observation that make up the state, or a function
            of observations ``[*B, obs]`` that gives it.
        history (int): observed frames handed over.
        replan_interval (int): steps executed per chunk.
        controller_columns (sequence of int, optional): columns of the state that the controller reads: its mask.
        history_key (NestedKey): observations ``[*B, history, obs]`` (:func:`policy_transforms`).
        action_key (NestedKey): action of the current step ``[*B, act]``.
        cached_key (NestedKey): entry of a chunk that is in force at the current step.
        chunk_key (NestedKey): the chunk.
        reader (str): what reads the last frames, in error messages.
        candidates (int): plans or chunks sampled whenever one is due, of which one is taken that goes on with the one
            in force (:mod:`torchrl_koap.modules.execution.candidates`).
        kept_steps (int, optional): entries of a chunk that are kept. Default: those that are executed.

    Attributes:
        action_gain (Tensor, optional): what every entry of an action is multiplied by ``[act]``: above 1 a robot whose
            actions are changes of a command is quicker than planned. None, unless set.
        leash (CommandLeash, optional): has the last word on actions; None, unless set.

    Raises:
        ValueError: for a history shorter than the planner's, or an interval longer than the horizon. At the first call
            for a history of another length.
        KeyError: at the first call, if the environment lacks :func:`policy_transforms`.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import ChunkedPolicy, DiffusionPolicy, TemporalUnet  # a subclass
        >>> sampler = DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3)
        >>> policy = ChunkedPolicy(sampler, state_columns=(2, 3), history=2, replan_interval=4)
        >>> policy.plan_and_decode(torch.zeros(5, 2, 4), torch.randn(5, *sampler.noise_shape)).shape
        torch.Size([5, 4, 3])
    """

    action_gain: Tensor | None

    def __init__(
        self,
        planner: nn.Module,
        *,
        state_columns: Sequence[int] | Callable[[Tensor], Tensor],
        history: int,
        replan_interval: int,
        controller_columns: Sequence[int] | None,
        history_key: NestedKey,
        action_key: NestedKey = ACTION,
        cached_key: NestedKey,
        chunk_key: NestedKey,
        reader: str = "planner",
        candidates: int = 1,
        kept_steps: int | None = None,
    ):
        super().__init__()
        check_candidates(candidates)
        if history < planner.history:
            raise ValueError(f"the {reader} reads {planner.history} observed frames, history is only {history}")
        if not 1 <= replan_interval <= planner.horizon:
            raise ValueError(f"replan_interval must be in 1..{planner.horizon} (the horizon), got {replan_interval}")
        columns = None if controller_columns is None else torch.as_tensor(controller_columns)
        self.register_buffer("controller_columns", columns, persistent=False)
        if callable(state_columns):
            self.state_of = state_columns
        else:
            self.register_buffer("state_columns", torch.as_tensor(state_columns), persistent=False)
            self.state_of, self._widest = self._select, int(max(state_columns))
        self.in_keys, self.out_keys = [history_key, IS_INIT], [action_key, chunk_key]
        self.history, self.replan_interval = history, replan_interval
        self.planner, self.candidates = planner, candidates
        self.register_buffer("action_gain", None, persistent=False)
        self.leash: CommandLeash | None = None
        self._written: TensorDictBase | None = None
        self.receding = MultiStepActorWrapper(
            _Chunk(self.make_chunk, planner.noise_key, chunk_key),
            n_steps=kept_steps or replan_interval,
            replan_interval=replan_interval,
            action_keys=[cached_key],
            chunk_keys=[chunk_key],
            init_key=IS_INIT,
        )

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of everything that is drawn for one environment whenever a plan is due."""
        return (*((self.candidates,) if self.candidates > 1 else ()), *self.planner.noise_shape)

    def make_chunk(
        self, history: Tensor, noise: Tensor | None, in_force: Tensor | None = None, fresh: Tensor | None = None
    ) -> Tensor:
        """What is in force in each of the next steps; a subclass says how it is made.

        Args:
            history (Tensor): observed states ``[*B, history, d]``, raw units.
            noise (Tensor, optional): ``[*B, *noise_shape]``, standard normal. Default: random.
            in_force (Tensor, optional): the chunk of before, which several candidates are compared with.
            fresh (Tensor, optional): where an episode begins, bool ``[*B]``.

        Returns:
            Tensor: ``[*B, replan_interval, ...]``, an entry per step.
        """
        raise NotImplementedError

    def plan_and_decode(self, observations: Tensor, noise: Tensor) -> Tensor:
        """The actions of the next ``replan_interval`` steps, decoded at once: stateless and without branches on data.

        This is what is exported: whoever calls it keeps the last observations and counts steps.

        Args:
            observations (Tensor): ``[*B, history, obs]``, raw units.
            noise (Tensor): ``[*B, *planner.noise_shape]``, standard normal.

        Returns:
            Tensor: ``[*B, replan_interval, act]``.
        """
        raise NotImplementedError

    def scaled(self, action: Tensor) -> Tensor:
        """Actions ``[*B, act]`` times :attr:`action_gain`, where there is one."""
        return action if self.action_gain is None else action * self.action_gain

    def act(self, history: Tensor, cached: Tensor) -> Tensor:
        """The action under the entry of the chunk that is in force; by default that entry itself.

        Args:
            history (Tensor): observed states ``[B, history, d]``, raw units.
            cached (Tensor): entry of the chunk that is in force: ``[B, ...]``.

        Returns:
            Tensor: ``[B, act]``, raw units.
        """
        return cached

    def decide(self, observed: Tensor, states: Tensor, cached: Tensor) -> Tensor:
        """The action of the current step before gain and leash; a subclass may replace entries of :meth:`act`.

        Args:
            observed (Tensor): observations ``[B, history, obs]``, raw units.
            states (Tensor): their states ``[B, history, d]``.
            cached (Tensor): entry of the chunk that is in force: ``[B, ...]``.

        Returns:
            Tensor: ``[B, act]``, raw units.
        """
        return self.act(states, cached)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of the current step (and the caches that the next one continues from)."""
        observed = tensordict.get(self.in_keys[0], None)
        for name, value in ((self.in_keys[0], observed), (IS_INIT, tensordict.get(IS_INIT, None))):
            if value is None:
                raise KeyError(f"the policy reads {name!r}: append policy_transforms() to the environment")
        if observed.shape[-2] != self.history:
            raise ValueError(
                f"{self.in_keys[0]!r} must hold {self.history} frames on axis -2, got {list(observed.shape)}"
            )
        batch, cached, chunk = tensordict.batch_size, self.receding.action_keys[0], self.out_keys[1]
        kept = [chunk, self.receding.counter_key]
        if self._written is not None and self._written.batch_size == batch and tensordict.get(chunk, None) is None:
            if not tensordict.get(IS_INIT).all():
                tensordict.update(self._written)
        tensordict = self._any_batch(tensordict, [*kept, cached])
        self._written = tensordict.select(*kept)
        if self.action_gain is not None:
            tensordict.set(self.out_keys[0], self.scaled(tensordict.get(self.out_keys[0])))
        return tensordict if self.leash is None else self.leash(tensordict)

    def _any_batch(self, tensordict: TensorDictBase, kept: list[NestedKey]) -> TensorDictBase:
        """One step of a batch of any shape."""
        batch = tensordict.batch_size
        if len(batch) == 1:
            return self._step(tensordict)
        noise = [] if self.planner.noise_key is None else [self.planner.noise_key]
        flat = tensordict.select(*self.in_keys, *noise, *kept, strict=False)
        flat = self._step(flat.reshape(-1) if batch else flat.unsqueeze(0))
        written = flat.select(*self.out_keys, *kept, STATE_HISTORY)
        return tensordict.update(written.reshape(batch) if batch else written[0])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One step of a batch ``[n]``."""
        tensordict.set(STATE_HISTORY, self.state_of(tensordict.get(self.in_keys[0])))
        tensordict = self.receding(tensordict)
        observed, states = tensordict.get(self.in_keys[0]), tensordict.get(STATE_HISTORY)
        cached = tensordict.get(self.receding.action_keys[0])
        return tensordict.set(self.out_keys[0], self.decide(observed, states, cached))

    def _select(self, observed: Tensor) -> Tensor:
        if observed.shape[-1] <= self._widest:
            raise ValueError(
                f"an observation must have at least {self._widest + 1} columns (state_columns),"
                f" got {observed.shape[-1]}"
            )
        return observed[..., self.state_columns]


class _Chunk(TensorDictModuleBase):
    """The part that runs only when a new chunk is due."""

    def __init__(self, make_chunk: Callable, noise_key: NestedKey | None, chunk_key: NestedKey):
        super().__init__()
        self.make_chunk, self.noise_key = make_chunk, noise_key
        self.in_keys, self.out_keys = [STATE_HISTORY], [chunk_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        noise = None if self.noise_key is None else tensordict.get(self.noise_key, None)
        in_force = tensordict.get(self.out_keys[0], None)
        fresh = tensordict.get(IS_INIT).squeeze(-1)
        chunk = self.make_chunk(tensordict.get(STATE_HISTORY), noise, in_force, fresh)
        return tensordict.set(self.out_keys[0], chunk)
