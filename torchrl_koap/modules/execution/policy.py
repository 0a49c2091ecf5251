# This source code is licensed under the MIT license found in the LICENSE file.
"""The policy, which makes a plan every few steps and follows it in between."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import MultiStepActorWrapper

from torchrl_koap.keys import ACTION, PLAN
from torchrl_koap.modules.execution.command_limits import CommandLimits
from torchrl_koap.modules.execution.execution import Execution
from torchrl_koap.modules.execution.followers import Follower, remaining_plan
from torchrl_koap.modules.planning.diffusion_policy import ACTION_CHUNK, DiffusionPolicy
from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.sampler import ConditionalSampler

OBSERVATION_HISTORY = "observation_history"
IS_INIT = "is_init"
PLANNED_STATE = "planned_state"
UNDER_WAY = "_step"  # TorchRL's mask of the environments of a batch whose episodes are still running


class PlanningPolicy(TensorDictModuleBase):
    """Samples plans of states and follows them, or samples chunks of actions and executes their beginning.

    :func:`~torchrl_koap.modules.make_policy` makes one from the facts of a task. Every environment of a batch re-plans
    at its own times, counted from its own reset (:class:`torchrl.modules.MultiStepActorWrapper`). Batches may have any
    shape, including ``[]`` for a single environment. The current plan is stored in the tensordict. The policy also
    remembers the last one that it wrote: a :class:`torchrl.envs.ParallelEnv` whose workers reset by themselves returns
    only its own entries. If it has acted in another environment since, it plans anew.

    :func:`torch.compile` does not change a policy, since data decide when plans are made; :meth:`compile` compiles its
    denoiser in place.

    Args:
        planner (StatePlanner or DiffusionPolicy): samples plans from the last observed states.
        follower (Follower, optional): turns plans into actions. Default: none, the planner samples actions.

    Keyword Args:
        state_of (callable, or sequence of int): maps observations ``[*B, obs]`` to states ``[*B, d]``, or lists the
            columns of the state.
        execution (Execution, optional): how plans become actions. Default: ``Execution()``.
        decoded (mapping, optional): for actions that are decoded as commands but executed as their changes, the columns
            of the ``"actions"`` and of the observations that repeat the last ``"commands"``.
        limits (CommandLimits, optional): limits actions last. ``limited``, int64 ``[2]``, counts the actions that left
            their range, and all.
        max_steps (int): steps of an episode, for all of which start noise is drawn together.
        control_hz (float, optional): frames per second of the data. Default: unknown.
        observe (callable, optional): maps robot data with camera frames to observations ``[*B, obs]``
            (:class:`~torchrl_koap.vision.Observer`). Default: the robot returns observations.
        origins (tuple, optional): offsets that were subtracted from observations ``[obs]`` and actions ``[act]`` of the
            data; an :class:`~torchrl_koap.modules.Agent` and exported files subtract and add them.
        history_key (NestedKey): observations ``[*B, history, obs]`` (:func:`~torchrl_koap.modules.policy_transforms`).
        action_key (NestedKey): action of the current step ``[*B, act]``. Plan and step counter stand beside it: give
            policies of one tensordict nested keys of different groups.

    Raises:
        ValueError: for a replan interval longer than the horizon, a follower that does not support the execution, a
            StatePlanner without follower or a DiffusionPolicy with one, or several candidates of a planner that is no
            ConditionalSampler; at a call for another batch size, history or noise, or a plan not ``[*B, H, d]``.
        KeyError: at a call, if the environment lacks :func:`~torchrl_koap.modules.policy_transforms`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import DiffusionPolicy, PlanningPolicy, TemporalUnet
        >>> sampler = DiffusionPolicy(TemporalUnet(3, 4), state_dim=2, action_dim=3)
        >>> policy = PlanningPolicy(sampler, state_of=(2, 3))
        >>> td = TensorDict({"observation_history": torch.zeros(5, 2, 4),
        ...                  "is_init": torch.ones(5, 1, dtype=torch.bool)}, [5])
        >>> policy(td)["action"].shape
        torch.Size([5, 3])
    """

    def __init__(
        self,
        planner: nn.Module,
        follower: Follower | None = None,
        *,
        state_of: Callable[[Tensor], Tensor] | Sequence[int],
        execution: Execution | None = None,
        decoded: Mapping[str, Sequence[int]] | None = None,
        limits: CommandLimits | None = None,
        max_steps: int = 400,
        control_hz: float | None = None,
        observe: Callable[[Mapping[str, Any]], Tensor] | None = None,
        origins: tuple[Sequence[float], Sequence[float]] | None = None,
        history_key: NestedKey = OBSERVATION_HISTORY,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        execution = Execution() if execution is None else execution
        if isinstance(planner, StatePlanner if follower is None else DiffusionPolicy):
            samples = "states: a controller must" if follower is None else "actions: no controller may"
            raise ValueError(f"{type(planner).__name__} samples {samples} decode them")
        if follower is None:  # the sampled actions are executed
            execution = execution.replaced(strategy="open_loop")
        if execution.candidates > 1 and not isinstance(planner, ConditionalSampler):
            raise ValueError(f"candidates must be 1 for {type(planner).__name__}, which is no ConditionalSampler")
        knows_command = follower is not None and follower.knows_command
        if knows_command and execution.strategy == "open_loop":
            raise ValueError(f"{type(follower).__name__} decodes at every step: strategy must not be 'open_loop'")
        if knows_command and execution.gain != 1:
            raise ValueError(f"{type(follower).__name__} models the response to commands: gain must be 1")
        if execution.replan_interval > planner.horizon:
            raise ValueError(
                f"replan_interval must be in 1..{planner.horizon} (the horizon), got {execution.replan_interval}"
            )
        self.planner, self.follower, self.limits = planner, follower, limits
        given = {} if decoded is None or knows_command else decoded  # such a follower already returns changes
        self.decoded = {name: list(columns) for name, columns in given.items()} or None
        self.execution, self.max_steps, self.control_hz = execution, max_steps, control_hz
        self.observe = observe
        self.register_buffer("limited", torch.zeros(2, dtype=torch.long), persistent=False)
        self.state_of = columns_of(state_of)
        self.origins = None if origins is None else [torch.tensor(part, dtype=torch.float64) for part in origins]
        self.history = max(planner.history, 1 if follower is None else follower.num_frames)
        self._decodes = follower is not None and execution.strategy != "open_loop"  # decodes at every step
        group = action_key[:-1] if isinstance(action_key, tuple) else ()
        chunk_key = unravel_key((*group, PLAN if self._decodes else ACTION_CHUNK))
        self.in_keys, self.out_keys = [history_key, IS_INIT], [action_key, chunk_key]
        self._action_key, self._chunk_key = action_key, chunk_key  # out_keys may be selected
        self._written: TensorDictBase | None = None
        self.receding = MultiStepActorWrapper(
            _Chunk(self.plan, history_key, planner.noise_key, chunk_key),
            replan_interval=execution.replan_interval,
            action_keys=[unravel_key((*group, PLANNED_STATE)) if self._decodes else action_key],
            chunk_keys=[chunk_key],
            init_key=unravel_key((*group, IS_INIT)),
        )

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of the start noise of one environment's plan, ``[candidates, H, w]`` for several candidates."""
        several = () if self.execution.candidates == 1 else (self.execution.candidates,)
        return (*several, *self.planner.noise_shape)

    def check_rate(self, control_hz: float) -> None:
        """Warns if a control rate (Hz) is outside 0.8 to 1.25 times that of the data; raises if it is not positive."""
        number = isinstance(control_hz, (int, float, np.number)) and not isinstance(control_hz, bool)
        if not (number and math.isfinite(control_hz) and control_hz > 0):
            raise ValueError(f"control_hz must be a positive number of steps per second, got {control_hz!r}")
        if self.control_hz is not None and not 0.8 <= control_hz / self.control_hz <= 1.25:
            warnings.warn(
                f"control_hz is {control_hz:g}, the policy was trained on data of {self.control_hz:g} Hz: its plans and"
                " commands are for steps of that length",
                stacklevel=3,
            )

    def from_robot(self, observations: Tensor) -> Tensor:
        """Subtracts the origin, if there is one, from the robot's observations ``[*B, obs]``, in float64."""
        if self.origins is None or observations.shape[-1] != len(self.origins[0]):
            return observations
        return observations.double() - self.origins[0].to(observations.device)

    def to_robot(self, actions: Tensor) -> Tensor:
        """Adds the origin, if there is one, to actions ``[*B, act]``, in float64."""
        return actions if self.origins is None else actions.double() + self.origins[1].to(actions.device)

    def plan(self, observations: Tensor, noise: Tensor | None = None) -> Tensor:
        """Makes the next plan: states ``[*B, H, d]``, or a chunk of actions ``[*B, n, act]``.

        Observations are ``[*B, history, obs]`` in raw units; noise is ``[*B, *noise_shape]``, drawn by default.
        """
        states = self.state_of(observations)
        chunk = self.sample(states, noise)
        if self._decodes or self.follower is None:
            return chunk
        return self.follower(observations, states, chunk, self.execution.replan_interval)

    def sample(self, states: Tensor, noise: Tensor | None = None, **options: Any) -> Tensor:
        """Samples plans ``[*B, H, w]`` at the temperature of the execution, from as many candidates as it says.

        The last observed states are ``[*B, history, d]``, the noise as for :meth:`plan`; options go to the planner's
        ``sample``, for example ``prefix``.
        """
        if noise is None:
            shape = (*states.shape[:-2], *self.noise_shape)
            noise = torch.randn(shape, dtype=states.dtype, device=states.device)
        seen = states[..., -self.planner.history :, :]
        if self.execution.candidates > 1:
            sample = partial(self.planner.sample_nearest, candidates=self.execution.candidates)
        else:
            sample = self.planner.sample
        chunk = sample(seen, self.execution.temperature * noise.to(states.dtype), **options)
        wanted = (*seen.shape[:-2], self.planner.horizon, seen.shape[-1])
        if self.follower is not None and chunk.shape != wanted:
            raise ValueError(f"a plan must be {list(wanted)} ([*B, horizon, d]), got {list(chunk.shape)}")
        return chunk

    def act(self, observations: Tensor, plan: Tensor, age: Tensor | int) -> Tensor:
        """Returns the action ``[*B, act]`` of a step, after command limits.

        Observations are ``[*B, history, obs]`` in raw units; the plan, from :meth:`plan`, is ``age [*B]`` steps old.
        """
        left = remaining_plan(plan, age)
        if self._decodes:
            left = self.follower(observations, self.state_of(observations), left)
        action, outside = self._executed(observations, left[..., 0, :])
        if self.limits is not None:
            self.limited += torch.stack([outside.sum(), torch.ones_like(outside).sum()])
        return action

    def decode_ahead(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Plans and decodes the actions of the next steps at once.

        Exported files hold this method: it is stateless and has no branches on data. The actions assume that the robot
        moves as commanded. Arguments as for :meth:`plan`.

        Returns:
            tuple: the actions ``[*B, replan_interval, act]``, and which of them were clipped to their range, bool
            ``[*B, replan_interval]``.
        """
        states, steps = self.state_of(observations), self.execution.replan_interval
        actions = self.sample(states, noise)
        if self.follower is not None:
            actions = self.follower(observations, states, actions, steps)
        moved: Tensor | float = 0.0
        found = []
        for action in actions[..., :steps, :].unbind(-2):
            found.append(self._executed(observations, action, moved))
            if self.decoded is not None:
                moved = moved + found[-1][0][..., self.decoded["actions"]]
        taken, outside = zip(*found, strict=True)
        return torch.stack(taken, -2), torch.stack(outside, -1)

    def _executed(self, observations: Tensor, action: Tensor, moved: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """Turns ``decoded`` commands in actions ``[*B, act]`` into changes, limits them and returns which were clipped.

        Since the observations ``[*B, history, obs]``, these commands have ``moved`` ``[*B, k]``.
        """
        if self.decoded is not None:
            columns, action = self.decoded["actions"], action.clone()
            last = observations[..., -1, self.decoded["commands"]] + moved
            action[..., columns] = (action[..., columns].to(last.dtype) - last).to(action.dtype)
        if self.limits is None:
            return action, torch.zeros_like(action[..., 0], dtype=torch.bool)
        return self.limits(observations, action)

    def attach(self, env: EnvBase) -> None:
        """Passes to the follower the batch of environments whose episodes are about to begin."""
        if self.follower is not None:
            self.follower.attach(env)

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compiles the denoiser, which takes most of the time; arguments as for :func:`torch.compile`."""
        self.planner.denoiser.compile(*args, **kwargs)

    @torch.compiler.disable  # a graph would freeze the step counter of its first call
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of the current step, and the plan that the next step continues."""
        observed, begins = tensordict.get(self.in_keys[0], None), tensordict.get(IS_INIT, None)
        for name, value in ((self.in_keys[0], observed), (IS_INIT, begins)):
            if value is None:
                raise KeyError(f"the policy reads {name!r}: use PolicyEnv(env, policy), or append policy_transforms()")
        batch, kept = tensordict.batch_size, [self._chunk_key, self.receding.counter_key]
        if observed.shape[:-1] != (*batch, self.history):
            raise ValueError(
                f"{self.in_keys[0]!r} must be {[*batch, self.history, 'obs']} (batch size, frames, columns),"
                f" got {list(observed.shape)}"
            )
        if any(tensordict.get(key, None) is None for key in kept) and not begins.all():
            if self._continues(tensordict):
                tensordict.update(self._written.select(*kept))
            else:  # the policy acted elsewhere in the meantime
                begins = torch.ones_like(begins)
        noise = [] if self.planner.noise_key is None else [self.planner.noise_key]
        # MultiStepActorWrapper needs exactly one batch dimension
        flat = tensordict.select(*self.in_keys, *noise, *kept, strict=False)
        flat = flat.set(self.receding.init_key, begins)
        flat = flat.reshape(-1) if batch else flat.unsqueeze(0)
        under_way = tensordict.get(UNDER_WAY, None)
        if under_way is None or under_way.all():
            written = self._step(flat)
        else:
            rows = under_way.reshape(-1)
            part = self._step(flat[rows])
            written = part.new_zeros(flat.batch_size).update(flat.select(*kept, strict=False).clone())
            written[rows] = part
        written = written.select(self._action_key, *kept, *self.receding.action_keys)
        tensordict.update(written.reshape(batch) if batch else written[0])
        # a copy of the history: environments in processes overwrite theirs
        self._written = tensordict.select(*kept).set(self.in_keys[0], observed.clone())
        return tensordict

    def _continues(self, tensordict: TensorDictBase) -> bool:
        """Whether all rows that are under way and do not begin are one step after those written last."""
        observed, begins = tensordict.get(self.in_keys[0]), tensordict.get(IS_INIT)
        before = None if self._written is None else self._written.get(self.in_keys[0])
        if before is None or before.shape != observed.shape:
            return False
        same = torch.isclose(observed[..., :-1, :], before[..., 1:, :], rtol=0.0, atol=0.0, equal_nan=True)
        follows = same.flatten(-2).all(-1, keepdim=True)
        idle = ~tensordict.get(UNDER_WAY, torch.ones_like(begins)).reshape(begins.shape)
        return bool((follows | begins | idle).all())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = self.receding(tensordict)
        observed, plan = tensordict.get(self.in_keys[0]), tensordict.get(self._chunk_key)
        age = tensordict.get(self.receding.counter_key).squeeze(-1).long() - 1
        return tensordict.set(self._action_key, self.act(observed, plan, age))


class _Chunk(TensorDictModuleBase):
    """Makes a plan when one is due. A TensorDictModule of a bound method would not be picklable."""

    def __init__(self, plan: Callable, history_key: NestedKey, noise_key: NestedKey | None, chunk_key: NestedKey):
        super().__init__()
        self.plan, self.noise_key = plan, noise_key
        self.in_keys, self.out_keys = [history_key], [chunk_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        noise = None if self.noise_key is None else tensordict.get(self.noise_key, None)
        return tensordict.set(self.out_keys[0], self.plan(tensordict.get(self.in_keys[0]), noise))


def columns_of(state_of: Callable[[Tensor], Tensor] | Sequence[int]) -> Callable[[Tensor], Tensor]:
    """Returns a function from observations to states; a list of columns becomes a module that selects them."""
    return state_of if callable(state_of) else _Columns(state_of)


class _Columns(nn.Module):
    def __init__(self, columns: Sequence[int]):
        super().__init__()
        self.register_buffer("columns", torch.as_tensor(columns), persistent=False)
        self._widest = int(max(columns))

    def forward(self, observed: Tensor) -> Tensor:
        if observed.shape[-1] <= self._widest:
            raise ValueError(
                f"an observation must have at least {self._widest + 1} columns (state_of), got {observed.shape[-1]}"
            )
        return observed[..., self.columns]
