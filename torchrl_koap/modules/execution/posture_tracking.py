# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans that are followed by the commands that demonstrations had there, for robots that are not seen whole."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.modules.execution.plan_then_control import PlanThenControl, blend_plan
from torchrl_koap.modules.koopman.command_posture import CommandPosture
from torchrl_koap.modules.planning.planner import StatePlanner

PULL = 0.3  # share of the distance to the posture that is gone at every step


class PostureTracking(PlanThenControl):
    r"""Plans future states and follows them by differences of the decoded command, drawn to the command itself.

    .. math::
        a_t = f(p_{t+1}) - f(x_t) + \rho\, (f(x_t) - c_t)

    with the decoded command ``f`` (:class:`~torchrl_koap.modules.CommandPosture`), the plan ``p`` bent into the present
    state, the command in force ``c``, which the policy knows, and the pull ``rho``. The first part moves what is seen;
    the second keeps what is not seen where demonstrations had it. Action entries that the posture does not have are
    decoded by the controller, as in :class:`~torchrl_koap.modules.PlanThenControl`.

    Args:
        planner (StatePlanner): plans states from the last observed ones.
        controller (InverseDynamics): decodes the other entries of the action.
        posture (CommandPosture): the command in a state, and the columns it is about.

    Keyword Args:
        pull (float): ``rho``. Defaults to ``0.3``.
        **options: as for :class:`~torchrl_koap.modules.PlanThenControl`.

    Raises:
        ValueError: as :class:`~torchrl_koap.modules.PlanThenControl`; if the execution is not ``"feedback"``, or
            the pull is not in [0, 1].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import (
        ...     CommandPosture, MLPDenoiser, PostureTracking, StatePlanner, make_koopman_inverse_dynamics)
        >>> planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2, num_steps=2)
        >>> posture = CommandPosture(2, [0, 1], [0, 1], width=8)
        >>> posture.set_scales(torch.randn(9, 2), torch.randn(9, 2))
        >>> policy = PostureTracking(planner, make_koopman_inverse_dynamics(2, 2), posture,
        ...                          state_columns=(2, 3), history=5)
        >>> td = TensorDict({"observation_history": torch.zeros(3, 5, 4),
        ...                  "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
        >>> policy(td)["action"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        planner: StatePlanner,
        controller: TensorDictModuleBase,
        posture: CommandPosture,
        *,
        pull: float = PULL,
        **options: Any,
    ):
        if options.get("execution", "feedback") != "feedback":
            raise ValueError(
                f"postures are followed at every step: execution must be 'feedback', got {options['execution']!r}"
            )
        if not 0 <= pull <= 1:
            raise ValueError(f"pull must be in [0, 1], got {pull}")
        super().__init__(planner, controller, **options)
        self.posture, self.pull = posture, pull

    def follow(self, now: Tensor, command: Tensor, plan: Tensor) -> Tensor:
        """Changes of the command that lead along a plan.

        Args:
            now (Tensor): the present state ``[*B, d]``.
            command (Tensor): in force ``[*B, J]``.
            plan (Tensor): states ``[*B, N, d]`` that leave from the present one.

        Returns:
            Tensor: ``[*B, N, J]``, as if every planned state was reached.
        """
        postures = self.posture(torch.cat([now.unsqueeze(-2), plan], -2))
        changes = []
        for step, posture in zip(postures.diff(dim=-2).unbind(-2), postures.unbind(-2)[:-1], strict=True):
            changes.append(step + self.pull * (posture - command))
            command = command + changes[-1]
        return torch.stack(changes, -2)

    def decide(self, observed: Tensor, states: Tensor, cached: Tensor) -> Tensor:
        """The decoded action with what postures tell; arguments as for :class:`RecedingHorizonPolicy`."""
        return self._replaced(observed, states, cached, self.act(states, cached).unsqueeze(-2))[..., 0, :]

    def _decode_ahead(self, observations: Tensor, states: Tensor, plan: Tensor) -> Tensor:
        return self._replaced(observations, states, plan, self._decode_chunk(states, plan))

    def _replaced(self, observed: Tensor, history: Tensor, plan: Tensor, action: Tensor) -> Tensor:
        """Decoded actions ``[*B, n, act]`` of the next steps with the entries that postures tell."""
        count, action = action.shape[-2], action.clone()
        now, command = history[..., -1, :], observed[..., -1, self.posture.commands]
        bent = blend_plan(history, plan, self.blend_decay)[..., :count, :]
        action[..., self.posture.actions] = self.follow(now, command, bent).to(action.dtype)
        return action
