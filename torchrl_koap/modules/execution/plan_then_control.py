# This source code is licensed under the MIT license found in the LICENSE file.
"""Planner and controller as one policy: plan states, turn them into actions, re-plan every few steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.keys import ACTION
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.candidates import paths_apart, sample_coherent
from torchrl_koap.modules.execution.receding_horizon import OBSERVATION_HISTORY, RecedingHorizonPolicy
from torchrl_koap.modules.planning.planner import StatePlanner

EXECUTIONS = ("feedback", "open_loop")


class PlanThenControl(RecedingHorizonPolicy):
    """Plans future states every few steps and decodes actions from observed history and plan.

    ``"feedback"`` decodes at every step from the history observed by then towards the plan that is in force; the plan
    alone is cached. ``"open_loop"`` (the paper) decodes a chunk of actions once per plan and executes its beginning::

        step            0          1          2          3          4
        plan made at    0                                           4
        feedback        a(x_0,P)   a(x_1,P)   a(x_2,P)   a(x_3,P)   a(x_4,P')
        open loop       a_0(x_0,P) a_1(x_0,P) a_2(x_0,P) a_3(x_0,P) a_0(x_4,P')

    Every environment of a batch re-plans in its own rhythm, counted from its own reset; batches may have any shape,
    ``[]`` of a single environment included.

    Before anything is decoded the plan is *blended* into the present state (:func:`blend_plan`). An inverse dynamics is
    fitted to motions that happened, in which no step leaps; a plan that begins beside the robot it tracks badly, or not
    at all.

    Args:
        planner (StatePlanner): plans states from the last observed ones.
        controller (InverseDynamics): reads a window of states ``[*B, T, d]`` and writes actions ``[*B, T, act]`` as
            the last of its out-keys.

    Keyword Args:
        state_columns (sequence of int, or callable): columns of the observation that make up the state, or a function
            of observations ``[*B, obs]`` that gives it, such as ``get_task("sorting").state_of``.
        history (int): observed frames handed to the controller (and, of these, the planner's own last ones).
        execution (str): ``"feedback"`` or ``"open_loop"``. Defaults to ``"feedback"``.
        replan_interval (int): steps per plan. Defaults to ``4``.
        blend_decay (float): share of the distance to the plan that remains after each frame. Defaults to ``0.8``; ``0``
            leaves plans as they are.
        controller_columns (sequence of int, optional): columns of the state that the controller reads: its mask.
            Default: all.
        action_rule (callable, optional): ``action_rule(states [B, T, d], actions [B, T, act]) -> actions`` has the last
            word on the actions of a window of observed and planned states; such as the gripper's number, which is read
            off the planned widths (:func:`~torchrl_koap.tasks.action_rules.command_gripper`).
        candidates (int): plans sampled whenever one is due, of which one that goes on with the plan in force is taken
            (:mod:`torchrl_koap.modules.execution.candidates`). Defaults to ``1``.
        history_key (NestedKey): observations ``[*B, history, obs]`` (:func:`policy_transforms`).
        action_key (NestedKey): action of the current step ``[*B, act]``.

    Raises:
        ValueError: for an unknown execution or rule, several candidates in open loop, a history shorter than the
            planner's or the controller's, or an interval longer than the horizon. At the first call for a history of
            another length.
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
        blend_decay: float = 0.8,
        controller_columns: Sequence[int] | None = None,
        action_rule: Callable[[Tensor, Tensor], Tensor] | None = None,
        candidates: int = 1,
        history_key: NestedKey = OBSERVATION_HISTORY,
        action_key: NestedKey = ACTION,
    ):
        lookup(EXECUTIONS, execution, "execution")
        # what is cached and handed out step by step: what remains of the plan, or actions
        feedback = execution == "feedback"
        super().__init__(
            planner,
            state_columns=state_columns,
            history=history,
            replan_interval=replan_interval,
            controller_columns=controller_columns,
            history_key=history_key,
            action_key=action_key,
            cached_key="remaining_plan" if feedback else action_key,
            chunk_key="remaining_plan_chunk" if feedback else "action_chunk",
            candidates=candidates,
        )
        if candidates > 1 and not feedback:
            raise ValueError(f"several candidates need execution 'feedback', which keeps its plan; got {execution!r}")
        if not 0 <= blend_decay < 1:
            raise ValueError(f"blend_decay must be in [0, 1), got {blend_decay}")
        read = getattr(controller, "num_past", 0) + 1
        if history < read:
            raise ValueError(f"the controller reads {read} observed frames, history is only {history}")
        self.execution, self.blend_decay, self.action_rule = execution, blend_decay, action_rule
        self.controller = controller

    def make_chunk(
        self, history: Tensor, noise: Tensor | None, in_force: Tensor | None = None, fresh: Tensor | None = None
    ) -> Tensor:
        """Plans, and gives what remains of the plan in each of the next steps, or decodes their actions.

        Args:
            history (Tensor): observed states ``[*B, history, d]``, raw units.
            noise (Tensor, optional): ``[*B, *noise_shape]``, standard normal. Default: random.
            in_force (Tensor, optional): the chunk of before ``[*B, replan_interval, H, d]``, its first entry the plan.
            fresh (Tensor, optional): where an episode begins, bool ``[*B]``.

        Returns:
            Tensor: ``[*B, replan_interval, H, d]`` with feedback, ``[*B, replan_interval, act]`` in open loop.
        """
        seen = history[..., -self.planner.history :, :]
        if self.candidates == 1:
            plan = self.planner.sample(seen, noise)
        else:
            plan = sample_coherent(
                self.planner.sample,
                self.planner.scale_columns,
                seen,
                noise,
                number=self.candidates,
                in_force=None if in_force is None else in_force[..., 0, :, :],
                fresh=fresh,
                apart=paths_apart,
            )
        return self._remaining_plans(plan) if self.execution == "feedback" else self._decode_chunk(history, plan)

    def plan_and_decode(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Plans and decodes the actions of the next steps.

        Args:
            observations (Tensor): ``[*B, history, obs]``, raw units.
            noise (Tensor): ``[*B, *planner.noise_shape]``, standard normal.

        Returns:
            Tensor: ``[*B, replan_interval, act]``.
        """
        states = self.state_of(observations)
        plan = self.planner.sample(states[..., -self.planner.history :, :], noise)
        return self.scaled(self._decode_ahead(observations, states, plan))

    def _decode_ahead(self, observations: Tensor, states: Tensor, plan: Tensor) -> Tensor:
        """The actions of the next steps ``[*B, interval, act]``, as if every planned state was reached."""
        return self._decode_chunk(states, plan)

    def act(self, history: Tensor, cached: Tensor) -> Tensor:
        """Decodes the action from what remains of the plan, or hands out the one decoded before.

        Args:
            history (Tensor): observed states ``[B, history, d]``, raw units.
            cached (Tensor): entry of the chunk that is in force: what remains of the plan ``[B, H, d]``, or the action
                ``[B, act]``.

        Returns:
            Tensor: ``[B, act]``, raw units.
        """
        return self._actions(history, cached)[..., self.history - 1, :] if self.execution == "feedback" else cached

    def _actions(self, history: Tensor, plan: Tensor) -> Tensor:
        """Actions ``[*B, T, act]`` of the window made of history and plan."""
        states = torch.cat([history, plan], -2)
        if self.controller_columns is not None:
            history, plan = history[..., self.controller_columns], plan[..., self.controller_columns]
        window = torch.cat([history, blend_plan(history, plan, self.blend_decay)], -2)
        name = self.controller.in_keys[0]
        out = self.controller(TensorDict({name: window}, batch_size=window.shape[:-2]))
        action = out.get(self.controller.out_keys[-1])
        return action if self.action_rule is None else self.action_rule(states, action)

    def _remaining_plans(self, plan: Tensor) -> Tensor:
        """What is left of the plan after 0, 1, ... steps, its last state repeated: ``[*B, interval, H, d]``."""
        steps = torch.arange(plan.shape[-2], device=plan.device)
        shifted = steps + torch.arange(self.replan_interval, device=plan.device)[:, None]
        return plan[..., shifted.clamp_max(plan.shape[-2] - 1), :]

    def _decode_chunk(self, history: Tensor, plan: Tensor) -> Tensor:
        """The actions of the next steps ``[*B, interval, act]``, decoded once."""
        now = self.history - 1
        return self._actions(history, plan)[..., now : now + self.replan_interval, :]


def blend_plan(history: Tensor, plan: Tensor, decay: float) -> Tensor:
    r"""Bends the beginning of a plan so that it leaves from the present state.

    .. math::
        x'_{t+k} = x_{t+k} + \rho^k e, \qquad e = x_t - (4 x_{t+1} + x_{t+2} - 2 x_{t+3}) / 3

    with the present state ``x_t`` and where the plan has the robot at present: its first three states, continued
    backwards along their least-squares line.

    Args:
        history (Tensor): observed states ``[*B, h, d]``, the present one last.
        plan (Tensor): planned states ``[*B, H, d]``; one shorter than three states is returned as it is.
        decay (float): ``rho``.

    Returns:
        Tensor: the bent plan ``[*B, H, d]``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import blend_plan
        >>> plan = torch.tensor([[2.0], [3.0], [4.0]])
        >>> blend_plan(torch.tensor([[0.0]]), plan, 0.5).flatten().tolist()  # the plan begins at 1, the robot is at 0
        [1.5, 2.75, 3.875]
    """
    if decay == 0 or plan.shape[-2] < 3:
        return plan
    first, second, third = plan[..., :3, :].unbind(-2)
    behind = history[..., -1, :] - (4 * first + second - 2 * third) / 3
    frames = torch.arange(1, plan.shape[-2] + 1, device=plan.device, dtype=plan.dtype)
    return plan + behind.unsqueeze(-2) * (decay**frames).unsqueeze(-1)
