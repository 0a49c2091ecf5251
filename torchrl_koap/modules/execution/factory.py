# This source code is licensed under the MIT license found in the LICENSE file.
"""Makes policies from a planner, a controller and the facts of a task."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_koap.modules.execution.command_limits import CommandLimits, Ranges
from torchrl_koap.modules.execution.execution import Execution
from torchrl_koap.modules.execution.followers import ActionRule, Follower, InverseDynamicsFollower
from torchrl_koap.modules.execution.mpc import MPC, ResponseModel
from torchrl_koap.modules.execution.policy import PlanningPolicy, columns_of


def make_policy(
    planner: nn.Module,
    controller: nn.Module | None = None,
    *,
    state_of: Callable[[Tensor], Tensor] | Sequence[int],
    execution: Execution | None = None,
    reads: Callable[[Tensor], Tensor] | None = None,
    action_rule: ActionRule | None = None,
    changes: Sequence[int] = (),
    commanded: Mapping[str, Sequence[int]] | None = None,
    ranges: Ranges | None = None,
    follower: Follower | None = None,
    **options: Any,
) -> PlanningPolicy:
    """Makes a policy from planner and controller; it maps observations to one action per control step.

    :func:`~torchrl_koap.training.policy_facts.policy_facts` returns the facts of a task as keyword arguments: all but
    ``execution``, ``follower``, ``observe`` and the keys.

    Args:
        planner (StatePlanner or DiffusionPolicy): samples plans, or actions that need no controller.
        controller (nn.Module, optional): an :class:`~torchrl_koap.modules.InverseDynamics` or a
            :class:`~torchrl_koap.modules.ResponseModel` (then :class:`~torchrl_koap.modules.MPC` follows the plans).

    Keyword Args:
        state_of (callable, or sequence of int): as for :class:`~torchrl_koap.modules.PlanningPolicy`, like
            ``execution`` and the options.
        reads (callable, optional): selects what an inverse dynamics reads of states ``[*B, T, d]``. Default: all.
        action_rule (callable, optional): as for ``Follower``.
        changes (sequence of int): action columns that are changes of a command; the gain multiplies them.
        commanded (mapping, optional): for each of these the observation column that repeats the command
            (``"commands"``) and the state column that it moves (``"states"``); needed for a lead.
        ranges (sequence, optional): demonstrated minimum and maximum of every action column, None for an unlimited
            one; ``execution.limits`` widens them. Default: no limits.
        follower (Follower, optional): follows plans in place of the controller.
        **options: ``decoded``, ``max_steps``, ``control_hz``, ``observe``, ``origins`` and the keys.

    Returns:
        PlanningPolicy: the policy, on the device of the networks.

    Raises:
        ValueError: as :class:`~torchrl_koap.modules.PlanningPolicy`; for a gain if no action is a change of a command;
            for a lead if no such command is observed.

    Examples:
        >>> from torchrl_koap.modules import Execution, StatePlanner, TemporalUnet, make_policy
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> policy = make_policy(planner, make_koopman_inverse_dynamics(2, 2), state_of=(2, 3))
        >>> policy.history, policy.execution.strategy
        (5, 'feedback')
    """
    execution = Execution() if execution is None else execution
    followed: dict[str, Any] = {"blend": execution.blend, "action_rule": action_rule}
    if follower is None and isinstance(controller, ResponseModel):
        look_ahead = planner.horizon - execution.replan_interval + 1  # planned states left at a plan's last step
        follower = MPC(controller, look_ahead=look_ahead, **followed)
    elif follower is None and controller is not None:
        follower = InverseDynamicsFollower(controller, reads=reads, **followed)
    limits, margin = None, execution.limits
    ranges = None if ranges is None or margin == math.inf else [_widened(r, margin) for r in ranges]
    if execution.gain != 1 or execution.lead or ranges is not None:
        own = {} if commanded is None else commanded
        limits = CommandLimits(
            changes,
            ranges=ranges,
            gain=execution.gain,
            lead=execution.lead,
            commands=own.get("commands", ()),
            positions=own.get("states", ()),
            state_of=columns_of(state_of),
        )
    policy = PlanningPolicy(planner, follower, state_of=state_of, execution=execution, limits=limits, **options)
    return policy.eval().to(next(policy.parameters(), torch.empty(0)).device)


def _widened(ends: Sequence[float] | None, margin: float) -> tuple[float, float] | None:
    if ends is None:
        return None
    low, high = ends
    return low - margin * (high - low), high + margin * (high - low)
