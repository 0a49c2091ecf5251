# This source code is licensed under the MIT license found in the LICENSE file.
"""States as seen from an object on the table: what differs only by its place and angle becomes one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class PlanarFrame(nn.Module):
    r"""Turns and moves planar columns of states into the frame of an object, and back.

    .. math::
        p' = R(-\theta) (p - o), \qquad u' = R(-\theta) u

    for positions ``p`` and directions ``u = (cos, sin)``, with place ``o`` and yaw ``theta`` of the object *at
    present*, also for states of the past and future: the frame stands still while a plan is made. Other columns stay.

    Args:
        points (sequence of pairs of int): columns ``(x, y)`` of the positions.
        directions (sequence of pairs of int): columns ``(cos, sin)`` of the yaws.
        origin (pair of int): columns ``(x, y)`` of the object.
        heading (pair of int): columns ``(cos, sin)`` of its yaw.

    Shape:
        states ``[*B, T, d]`` and present ones ``[*B, 1, d]`` to ``[*B, T, d]``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.planar_frame import PlanarFrame
        >>> frame = PlanarFrame([(0, 1), (2, 3)], [(4, 5)], origin=(2, 3), heading=(4, 5))
        >>> state = torch.tensor([[0.1, 0.3, 0.1, 0.2, 0.0, 1.0]])  # 0.1 m ahead of an object turned by 90 deg
        >>> seen = frame(state, state)
        >>> seen, torch.allclose(frame.inverse(seen, state), state)
        (tensor([[0.1000, 0.0000, 0.0000, 0.0000, 1.0000, 0.0000]]), True)
    """

    def __init__(
        self,
        points: Sequence[tuple[int, int]],
        directions: Sequence[tuple[int, int]],
        *,
        origin: tuple[int, int],
        heading: tuple[int, int],
    ):
        super().__init__()
        self.points, self.directions = [list(pair) for pair in points], [list(pair) for pair in directions]
        self.origin, self.heading = list(origin), list(heading)

    def forward(self, states: Tensor, present: Tensor) -> Tensor:
        """States as seen from the object."""
        seen, place, yaw = states.clone(), present[..., self.origin], present[..., self.heading]
        for pair in self.points:
            seen[..., pair] = _turned(states[..., pair] - place, yaw, back=True)
        for pair in self.directions:
            seen[..., pair] = _turned(states[..., pair], yaw, back=True)
        return seen

    def inverse(self, seen: Tensor, present: Tensor) -> Tensor:
        """States in the world again; ``present`` are those of the world."""
        states, place, yaw = seen.clone(), present[..., self.origin], present[..., self.heading]
        for pair in self.points:
            states[..., pair] = _turned(seen[..., pair], yaw, back=False) + place
        for pair in self.directions:
            states[..., pair] = _turned(seen[..., pair], yaw, back=False)
        return states


def _turned(vectors: Tensor, yaw: Tensor, *, back: bool) -> Tensor:
    x, y = vectors.unbind(-1)
    cosine, sine = yaw.unbind(-1)
    sine = -sine if back else sine
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)
