# This source code is licensed under the MIT license found in the LICENSE file.
"""What has the last word on the actions that a controller decodes: grippers and absolute targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchrl_koap.tasks.gripper import command_gripper


@dataclass(frozen=True)
class ActionRule:
    """Turns decoded actions into those that the robot takes.

    Args:
        gripper (tuple of int, optional): action column and state column of a gripper whose number is read off the
            widths (:func:`~torchrl_koap.tasks.gripper.command_gripper`).
        targets (sequence of int): for absolute actions the state column that each is the target of: the controller has
            decoded the distance to it.

    Examples:
        >>> import torch
        >>> from torchrl_koap.tasks.action_rules import ActionRule
        >>> states, decoded = torch.tensor([[[1.0, 5.0]]]), torch.tensor([[[0.25]]])
        >>> ActionRule(targets=(1,))(states, decoded)
        tensor([[[5.2500]]])
    """

    gripper: tuple[int, int] | None = None
    targets: Sequence[int] = ()

    def __call__(self, states: Tensor, actions: Tensor) -> Tensor:
        """The actions ``[*B, T, act]`` in states ``[*B, T, d]``."""
        if self.targets:
            actions = actions + states[..., list(self.targets)]
        if self.gripper is not None:
            actions = command_gripper(states, actions, entry=self.gripper[0], column=self.gripper[1])
        return actions
