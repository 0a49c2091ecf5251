# This source code is licensed under the MIT license found in the LICENSE file.
"""Modes, the ways in which a task can be done: their number, their names, and how environments report them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Modes:
    """The ways in which a task can be done.

    Args:
        choices (tuple): the choices that make up a mode, each ``(choice, names of its values)``, slowest digit first.
        leaves (tuple): the environment's leaf ``mode``, or its first entries, for every mode number. Empty: there is
            one mode.
        entropy (str): episodes that the entropy of modes is computed over: ``"all"`` successful ones together, or
            per context and then averaged over ``"contexts"`` or ``"solved_contexts"`` (those with a success).
        of_path (str, optional): import string of the function from recorded positions of the tool ``[T, 2]`` (numpy, m)
            to the number of the mode, -1 if undecided; None if the path does not determine it.

    Examples:
        >>> from torchrl_koap.tasks import Modes
        >>> modes = Modes((("row 1", ("left", "right")), ("row 2", ("left", "middle", "right"))))
        >>> modes.number, modes.name_of(5), modes.name_of(-1)
        (6, 'right, right', 'no mode')
        >>> Modes((("side", ("left", "right")),), leaves=((0,), (1,))).index_of(torch.tensor([[1], [-1]]))
        tensor([ 1, -1])
    """

    choices: tuple[tuple[str, tuple[str, ...]], ...] = ()
    leaves: tuple[tuple[int, ...], ...] = ()
    entropy: str = "all"
    of_path: str | None = None

    @property
    def number(self) -> int:
        """Number of modes; 1 if there are no choices."""
        return math.prod(len(names) for _, names in self.choices)

    def name_of(self, index: int) -> str:
        """Names a mode by its choices, slowest first; ``"no mode"`` for a number out of range."""
        if not 0 <= index < self.number:
            return "no mode"
        words = []
        for _, names in reversed(self.choices):
            index, digit = divmod(index, len(names))
            words.append(names[digit])
        return ", ".join(reversed(words))

    def index_of(self, leaf: Tensor) -> Tensor:
        """Returns the mode numbers of leaves ``mode`` ``[*B, entries]``, int64 ``[*B]``, -1 while undecided.

        Raises:
            ValueError: if a leaf has fewer entries than ``leaves``.
        """
        leaves = torch.tensor(self.leaves or ((),), device=leaf.device)
        entries = leaves.shape[-1]
        if leaf.shape[-1] < entries:
            raise ValueError(f"mode must have {entries} entries on the last axis, got shape {list(leaf.shape)}")
        same = (leaf[..., None, :entries] == leaves).all(-1)
        return torch.where(same.any(-1), same.to(torch.int64).argmax(-1), -1)


def note_arrivals(orders: np.ndarray, distance: np.ndarray, inside: np.ndarray) -> None:
    """Records which bodies have arrived, as D3IL does: at most one per call, the nearest that is not recorded yet.

    Writes body numbers into ``orders`` ``[n, bodies]`` in order of arrival, -1 after the last. ``distance`` (m) is that
    of each body from its goal; ``inside``, bool, is whether it is there. Bodies that leave again stay recorded.
    """
    noted = (orders[:, :, None] == np.arange(orders.shape[1])).any(1)
    nearest = np.where(noted, np.inf, distance).argmin(1)
    rows = np.flatnonzero(inside[np.arange(len(orders)), nearest] & ~noted.all(1))
    orders[rows, noted.sum(1)[rows]] = nearest[rows]
