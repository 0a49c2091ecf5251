# This source code is licensed under the MIT license found in the LICENSE file.
"""Relative position features: where the tool is as seen from the objects, to a millimetre near a contact.

A state tells tool and objects in world coordinates, to some per cent of the table's size once it is normalised. The
difference of two positions, turned into the object's own frame and magnified near zero, tells them to a millimetre.
These numbers only ever join the planner's condition; plans stay states.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

NEAR = (0.05, 0.015)  # m; distances that the magnified copies resolve


class RelativePositionFeatures(nn.Module):
    r"""Relative positions of the current state, plain and magnified near zero.

    .. math::
        d = R(-\theta) (p - o), \qquad (d,\; \tanh(d / 0.05\,\mathrm{m}),\; \tanh(d / 0.015\,\mathrm{m}))

    for every position ``p`` to an origin ``o`` with yaw ``theta``; heights are not turned. Histories of states ``[*B,
    h, d]`` give ``[*B, num_features]``, by their last frame.

    Args:
        pairs (sequence): state columns of up to four parts each: a position of 2 or 3 columns; the position it is seen
            from, whose height is taken as it is where it has 2; ``cos, sin`` of the yaw of the frame it is seen in;
            ``cos, sin`` of a yaw to be told relative to that frame, too.
    """

    def __init__(self, pairs: Sequence[Sequence[slice]]):
        super().__init__()
        self.pairs = [(*pair, None, None)[:4] for pair in pairs]

    @property
    def num_features(self) -> int:
        """Number of features."""
        sizes = (place.stop - place.start for place, *_ in self.pairs)
        return sum((1 + len(NEAR)) * size for size in sizes) + sum(2 for *_, turned in self.pairs if turned)

    def forward(self, history: Tensor) -> Tensor:
        """Features of the last frame."""
        state = history[..., -1, :]
        parts = []
        for *positions, yaw, turned in self.pairs:
            place, origin = (state[..., columns] for columns in positions)
            shared = min(place.shape[-1], origin.shape[-1])
            gap = torch.cat([place[..., :shared] - origin[..., :shared], place[..., shared:]], -1)
            if yaw is not None:
                frame = state[..., yaw]
                gap = torch.cat([_turn_back(gap[..., :2], frame), gap[..., 2:]], -1)
                if turned is not None:
                    parts.append(_turn_back(state[..., turned], frame))
            parts += [gap, *(torch.tanh(gap / near) for near in NEAR)]
        return torch.cat(parts, -1)


def _turn_back(vector: Tensor, yaw: Tensor) -> Tensor:
    x, y = vector.unbind(-1)
    cosine, sine = yaw.unbind(-1)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x], -1)
