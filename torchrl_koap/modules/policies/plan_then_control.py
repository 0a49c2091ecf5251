# This source code is licensed under the MIT license found in the LICENSE file.
"""Planner and controller as one policy: plan states, turn them into actions, re-plan every few steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.transforms import CatFrames, Compose, InitTracker, UnsqueezeTransform
from torchrl.modules import MultiStepActorWrapper

from torchrl_koap.keys import ACTION, OBSERVATION, PLAN
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.diffusion.planner import StatePlanner
from torchrl_koap.modules.policies.candidates import check_candidates, paths_apart, sample_coherent
from torchrl_koap.tasks.gripper import PLANNED_OPEN_ABOVE, gripper_number

EXECUTIONS = ("feedback", "open_loop")
OBSERVATION_HISTORY = "observation_history"
NOISE = "noise"


def policy_transforms(history: int, *, observation_key: NestedKey = OBSERVATION) -> Compose:
    """Environment transforms that :class:`PlanThenControl` needs: ``is_init`` and the last ``history`` observations.

    At the start of an episode the first observation is repeated.

    Examples:
        >>> from torchrl_koap.modules import policy_transforms
        >>> len(policy_transforms(5))
        3
    """
    return Compose(
        InitTracker(),
        UnsqueezeTransform(-2, in_keys=[observation_key], out_keys=[OBSERVATION_HISTORY]),
        CatFrames(N=history, dim=-2, in_keys=[OBSERVATION_HISTORY], out_keys=[OBSERVATION_HISTORY]),
    )


class PlanThenControl(TensorDictModuleBase):
    """Plans future states every few steps and decodes actions from observed history and plan.

    ``"feedback"`` decodes at every step from the history observed by then towards the plan that is in force; the plan
    alone is cached. ``"open_loop"`` (the paper) decodes a chunk of actions once per plan and executes its beginning::

        step            0          1          2          3          4
        plan made at    0                                           4
        feedback        a(x_0,P)   a(x_1,P)   a(x_2,P)   a(x_3,P)   a(x_4,P')
        open loop       a_0(x_0,P) a_1(x_0,P) a_2(x_0,P) a_3(x_0,P) a_0(x_4,P')

    Every environment of a batch re-plans in its own rhythm, counted from its own reset
    (:class:`torchrl.modules.MultiStepActorWrapper`).

    Before anything is decoded the plan is *joined* to the present state (:func:`join_plan`). An inverse dynamics is
    fitted to motions that happened, in which no step leaps; a plan that begins beside the robot it tracks badly, or not
    at all.

    Args:
        planner (StatePlanner): plans states from the last observed ones.
        controller (TensorDictModuleBase): reads a window of states ``[*B, T, d]`` and writes actions
            ``[*B, T, act]`` as the last of its out-keys; the :class:`KoopmanInverseDynamics` or any other inverse
            dynamics.

    Keyword Args:
        state_columns (sequence of int, or callable): columns of the observation that make up the state, or a function
            of observations ``[*B, obs]`` that gives it, such as ``get_task("sorting").state_of``.
        history (int): observed frames handed to the controller (and, of these, the planner's own last ones).
        execution (str): ``"feedback"`` or ``"open_loop"``. Defaults to ``"feedback"``.
        replan_interval (int): steps per plan. Defaults to ``4``.
        joining (float): share of the distance to the plan that remains after each frame. Defaults to ``0.8``; ``0``
            leaves plans as they are.
        tempo (float): how much quicker than planned a plan is executed (:func:`quicken_plan`); ``1`` leaves plans as
            they are. Defaults to ``1``.
        controller_columns (sequence of int, optional): columns of the state that the controller reads: its mask.
            Default: all.
        gripper (tuple of int, optional): action entry and state column of a gripper whose number is read off the
            planned widths (:mod:`torchrl_koap.tasks.gripper`).
        candidates (int): plans sampled whenever one is due, of which one that goes on with the plan in force is taken
            (:mod:`torchrl_koap.modules.policies.candidates`). Defaults to ``1``.
        choice (str): the rule by which it is taken. Defaults to ``"quarter"``.
        history_key (NestedKey): observations ``[*B, history, obs]`` (:func:`policy_transforms`).
        action_key (NestedKey): action of the current step ``[*B, act]``.

    Raises:
        ValueError: for an unknown execution or rule, several candidates in open loop, a history shorter than the
            planner's, or an interval longer than the horizon. At the first call for a history of another length.
        KeyError: at the first call, if the environment lacks :func:`policy_transforms`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import PlanThenControl, StatePlanner, TemporalUnet, make_koopman_inverse_dynamics
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> policy = PlanThenControl(
        ...     planner, make_koopman_inverse_dynamics(2, 2), state_columns=(2, 3), history=5)
        >>> td = TensorDict({"observation_history": torch.zeros(3, 5, 4),
        ...                  "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
        >>> policy(td)["action"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        planner: StatePlanner,
        controller: TensorDictModuleBase,
        *,
        state_columns: Sequence[int] | Callable[[Tensor], Tensor],
        history: int,
        execution: str = "feedback",
        replan_interval: int = 4,
        joining: float = 0.8,
        tempo: float = 1.0,
        controller_columns: Sequence[int] | None = None,
        gripper: tuple[int, int] | None = None,
        candidates: int = 1,
        choice: str = "quarter",
        history_key: NestedKey = OBSERVATION_HISTORY,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        lookup(EXECUTIONS, execution, "execution")
        if history < planner.history:
            raise ValueError(f"the planner reads {planner.history} observed frames, history is only {history}")
        if not 1 <= replan_interval <= planner.horizon:
            raise ValueError(f"replan_interval must be in 1..{planner.horizon} (the horizon), got {replan_interval}")
        if not 0 <= joining < 1:
            raise ValueError(f"joining must be in [0, 1), got {joining}")
        if not 0.5 <= tempo <= 2:
            raise ValueError(f"tempo must be in [0.5, 2], got {tempo}")
        check_candidates(candidates, choice)
        if candidates > 1 and execution != "feedback":
            raise ValueError(f"several candidates need execution 'feedback', which keeps its plan; got {execution!r}")
        self.joining, self.candidates = joining, candidates
        columns = None if controller_columns is None else torch.as_tensor(controller_columns)
        self.register_buffer("controller_columns", columns, persistent=False)
        self.gripper = gripper
        self.in_keys = [history_key, "is_init"]
        self.execution, self.history, self.replan_interval = execution, history, replan_interval
        if callable(state_columns):
            self._state_of = state_columns
        else:
            self.register_buffer("state_columns", torch.as_tensor(state_columns), persistent=False)
            self._state_of = self._select
        self.planner, self.controller = planner, controller
        # the chunk that the wrapper caches and hands out step by step: remaining plans, or actions
        cached = ["remaining_plan"] if execution == "feedback" else [action_key]
        chunk = "remaining_plan_chunk" if execution == "feedback" else "action_chunk"
        self.out_keys = [action_key, chunk]
        self.receding = MultiStepActorWrapper(
            _Chunk(
                planner,
                self._remaining_plans if execution == "feedback" else self._decode_chunk,
                chunk,
                candidates=candidates,
                choice=choice,
                tempo=tempo,
            ),
            n_steps=replan_interval,
            action_keys=cached,
            chunk_keys=[chunk],
            init_key="is_init",
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of the current step (and the caches that the next one continues from)."""
        observed = tensordict.get(self.in_keys[0], None)
        if observed is None:
            raise KeyError(f"the policy reads {self.in_keys[0]!r}: append policy_transforms() to the environment")
        if tensordict.get("is_init", None) is None:
            raise KeyError("the policy reads 'is_init': append policy_transforms() to the environment")
        if observed.shape[-2] != self.history:
            raise ValueError(
                f"{self.in_keys[0]!r} must hold {self.history} frames on axis -2, got {list(observed.shape)}"
            )
        tensordict.set("state_history", self._state_of(observed))
        tensordict = self.receding(tensordict)
        if self.execution == "feedback":
            actions = self._actions(tensordict.get("state_history"), tensordict.get("remaining_plan"))
            tensordict.set(self.out_keys[0], actions[..., self.history - 1, :])
        return tensordict

    def _select(self, observed: Tensor) -> Tensor:
        return observed[..., self.state_columns]

    def _actions(self, history: Tensor, plan: Tensor) -> Tensor:
        """Actions ``[*B, T, act]`` of the window made of history and plan."""
        widths = None if self.gripper is None else torch.cat([history, plan], -2)[..., self.gripper[1]]
        if self.controller_columns is not None:
            history, plan = history[..., self.controller_columns], plan[..., self.controller_columns]
        window = torch.cat([history, join_plan(history, plan, self.joining)], -2)
        name = self.controller.in_keys[0]
        out = self.controller(TensorDict({name: window}, batch_size=window.shape[:-2]))
        action = out.get(self.controller.out_keys[-1])
        if widths is not None:
            action[..., :-1, self.gripper[0]] = gripper_number(widths, open_above=PLANNED_OPEN_ABOVE)
        return action

    def _remaining_plans(self, history: Tensor, plan: Tensor) -> Tensor:
        """What is left of the plan after 0, 1, ... steps, its last state repeated: ``[*B, interval, H, d]``."""
        steps = torch.arange(plan.shape[-2], device=plan.device)
        shifted = steps + torch.arange(self.replan_interval, device=plan.device)[:, None]
        return plan[..., shifted.clamp_max(plan.shape[-2] - 1), :]

    def _decode_chunk(self, history: Tensor, plan: Tensor) -> Tensor:
        """The actions of the next steps ``[*B, interval, act]``, decoded once."""
        now = self.history - 1
        return self._actions(history, plan)[..., now : now + self.replan_interval, :]


def join_plan(history: Tensor, plan: Tensor, decay: float) -> Tensor:
    r"""Bends the beginning of a plan so that it leaves from the present state.

    .. math::
        x'_{t+k} = x_{t+k} + \rho^k e, \qquad e = x_t - (4 x_{t+1} + x_{t+2} - 2 x_{t+3}) / 3

    with the present state ``x_t`` and where the plan has the robot at present: its first three states, continued
    backwards along their least-squares line.

    Args:
        history (Tensor): observed states ``[*B, h, d]``, the present one last.
        plan (Tensor): planned states ``[*B, H, d]``; one shorter than three states is returned as it is.
        decay (float): ``rho``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import join_plan
        >>> plan = torch.tensor([[2.0], [3.0], [4.0]])
        >>> join_plan(torch.tensor([[0.0]]), plan, 0.5).flatten().tolist()  # the plan begins at 1, the robot is at 0
        [1.5, 2.75, 3.875]
    """
    if decay == 0 or plan.shape[-2] < 3:
        return plan
    first, second, third = plan[..., :3, :].unbind(-2)
    behind = history[..., -1, :] - (4 * first + second - 2 * third) / 3
    frames = torch.arange(1, plan.shape[-2] + 1, device=plan.device, dtype=plan.dtype)
    return plan + behind.unsqueeze(-2) * (decay**frames).unsqueeze(-1)


def quicken_plan(history: Tensor, plan: Tensor, tempo: float) -> Tensor:
    """Goes through a plan quicker (or slower), by linear interpolation between its states.

    A policy that lags a little behind its plans observes a lower speed than planned, plans the next ones at that speed,
    and so takes longer than the demonstrations.

    Args:
        history (Tensor): observed states ``[*B, h, d]``, the present one last.
        plan (Tensor): planned states ``[*B, H, d]``. The last one is repeated where a quicker plan is over.
        tempo (float): planned steps per executed step.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.policies.plan_then_control import quicken_plan
        >>> plan = torch.tensor([[1.0], [2.0], [3.0], [5.0]])
        >>> quicken_plan(torch.tensor([[0.0]]), plan, 1.5).flatten().tolist()
        [1.5, 3.0, 5.0, 5.0]
    """
    if tempo == 1:
        return plan
    states = torch.cat([history[..., -1:, :], plan], -2)
    last = plan.shape[-2]
    times = (tempo * torch.arange(1, last + 1, device=plan.device, dtype=plan.dtype)).clamp_max(last)
    before = times.floor().clamp_max(last - 1).long()
    share = (times - before).unsqueeze(-1)
    return states[..., before, :] * (1 - share) + states[..., before + 1, :] * share


class _Chunk(TensorDictModuleBase):
    """The part that runs only when a new plan is due."""

    def __init__(
        self, planner: StatePlanner, make_chunk, chunk_key: str, *, candidates: int, choice: str, tempo: float
    ):
        super().__init__()
        self.planner, self.make_chunk = planner, make_chunk
        self.candidates, self.choice, self.tempo = candidates, choice, tempo
        self.in_keys, self.out_keys = ["state_history"], [PLAN, chunk_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        history = tensordict.get("state_history")
        seen, noise = history[..., -self.planner.history :, :], tensordict.get(NOISE, None)
        if self.candidates == 1:
            plan = self.planner.plan(seen, noise)
        else:
            chunk = tensordict.get(self.out_keys[1], None)  # [*B, interval, H, d], the plan as it was and shortened
            plan = sample_coherent(
                self.planner.plan,
                self.planner.scale_columns,
                seen,
                noise,
                number=self.candidates,
                rule=self.choice,
                in_force=None if chunk is None else chunk[..., 0, :, :],
                fresh=tensordict.get("is_init").squeeze(-1),
                apart=paths_apart,
            )
        plan = quicken_plan(history, plan, self.tempo)
        tensordict.set(PLAN, plan)
        return tensordict.set(self.out_keys[1], self.make_chunk(history, plan))


class RecordedFutures(TensorDictModuleBase):
    """Hands recorded futures to a :class:`RecordedPlanner`, in place of noise.

    Args:
        futures (Tensor): for every environment and control step the states that follow ``[E, steps, H, d]``.
    """

    def __init__(self, futures: Tensor):
        super().__init__()
        self.in_keys, self.out_keys = [], [NOISE]
        self.register_buffer("futures", futures, persistent=False)
        self.step = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the futures of the current step (the last ones when the record is over) and moves on."""
        tensordict.set(NOISE, self.futures[:, min(self.step, self.futures.shape[1] - 1)])
        self.step += 1
        return tensordict


class RecordedPlanner(nn.Module):
    """A planner that knows the recorded future: what a controller does under it is its own doing.

    Args:
        planner (StatePlanner): the planner whose history, horizon and state it has.
    """

    def __init__(self, planner: StatePlanner):
        super().__init__()
        for name in ("history", "horizon", "state_dim"):
            setattr(self, name, getattr(planner, name))

    def plan(self, history: Tensor, noise: Tensor) -> Tensor:
        """The futures that :class:`RecordedFutures` wrote, ``[*B, H, d]``."""
        return noise.expand(*history.shape[:-2], -1, -1)


class EpisodeNoise(TensorDictModuleBase):
    """Start noise of the planner that depends on an episode's seed and step alone, not on the batch it runs in.

    Args:
        seeds (sequence of int): one per environment.
        shape (sequence of int): shape of one draw, ``[H, d]`` or ``[1 + solver steps, H, d]``.
        num_steps (int): control steps to draw for.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import EpisodeNoise
        >>> noise = EpisodeNoise([7, 8], (14, 2), num_steps=3)
        >>> first = noise(TensorDict(batch_size=[2]))["noise"]
        >>> bool((EpisodeNoise([8], (14, 2), num_steps=3)(TensorDict(batch_size=[1]))["noise"] == first[1]).all())
        True
    """

    def __init__(self, seeds: Sequence[int], shape: Sequence[int], *, num_steps: int):
        super().__init__()
        self.in_keys, self.out_keys = [], [NOISE]
        draws = [torch.randn(num_steps, *shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        self.register_buffer("draws", torch.stack(draws), persistent=False)  # [E, steps, *shape]
        self.step = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the noise of the current step and moves on to the next."""
        if self.step == self.draws.shape[1]:
            raise RuntimeError(f"noise was drawn for {self.step} steps only")
        tensordict.set(NOISE, self.draws[:, self.step])
        self.step += 1
        return tensordict
