# This source code is licensed under the MIT license found in the LICENSE file.
"""A denoiser with one token per object, whose weights all objects share; default of Sorting and Stacking."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_koap.modules.planning.denoisers import EMBEDDING_DIM, ConditionEncoder, Denoiser


class ObjectColumns(NamedTuple):
    """Columns of one object for :class:`ObjectDenoiser`.

    Args:
        sequence (sequence of int): its columns in sequences, ascending; empty if these are actions.
        condition (sequence of int): its columns in conditions, ascending.
        kind (int): its kind, counted from 0.
    """

    sequence: Sequence[int]
    condition: Sequence[int]
    kind: int = 0


class ObjectDenoiser(Denoiser):
    """Residual network with one token for the robot and one per object (Deep Sets, Zaheer et al. 2017).

    A layer adds to each token a function of itself, of the robot's token, and of mean and maximum of the objects'
    tokens. All objects share these weights; kinds differ by a learned vector. Columns that no object has are the
    robot's. If none of them relates objects, plans do not depend on the order of objects of one kind.
    :class:`~torchrl_koap.modules.planning.denoisers.MLPDenoiser` has to learn this from permuted scenes.

    Args and errors as for :class:`~torchrl_koap.modules.planning.denoisers.Denoiser`.

    Keyword Args:
        objects (sequence of ObjectColumns): columns of each object, equally many for all.
        horizon (int): number ``H`` of planned steps.
        width (int): width of a token. Defaults to 192.
        depth (int): number of residual layers. Defaults to 3.
        frequencies (int): octaves of the condition's Fourier features. Defaults to 1.

    Raises:
        ValueError: without objects, or if they differ in their numbers of columns.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import ObjectColumns, ObjectDenoiser
        >>> boxes = [ObjectColumns([2, 3], [2, 3]), ObjectColumns([4, 5], [4, 5])]
        >>> network = ObjectDenoiser(6, 6, objects=boxes, horizon=14)
        >>> network(torch.randn(3, 14, 6), torch.zeros(3), torch.randn(3, 6)).shape
        torch.Size([3, 14, 6])
    """

    def __init__(
        self,
        state_dim: int,
        condition_dim: int,
        *,
        objects: Sequence[ObjectColumns],
        horizon: int,
        width: int = 192,
        depth: int = 3,
        frequencies: int = 1,
    ):
        super().__init__(state_dim, condition_dim, horizon=horizon)
        sizes = {(len(each.sequence), len(each.condition)) for each in objects}
        if len(sizes) != 1:
            raise ValueError(f"objects must have equally many columns, got {sorted(sizes)} (of sequences, conditions)")
        ((own_planned, own_seen),) = sizes
        sequences, conditions = [each.sequence for each in objects], [each.condition for each in objects]
        robot_sequence, robot_condition = _others(state_dim, sequences), _others(condition_dim, conditions)
        planned, seen = len(robot_sequence), len(robot_condition)
        self.width = width
        # slices: lists of columns would be copied to a GPU in each call
        self.planned = [_slices(columns) for columns in (robot_sequence, *sequences)]
        self.seen = [_slices(columns) for columns in (robot_condition, *conditions)]
        self.kind_of = [each.kind for each in objects]
        self.kinds = nn.ParameterList(torch.randn(width) for _ in range(1 + max(self.kind_of)))
        self.robot_plan = nn.Linear(horizon * planned, width)
        self.object_plan = nn.Linear(horizon * (planned + own_planned), width)
        self.robot_encoder = ConditionEncoder(seen, frequencies=frequencies, width=width)
        self.object_encoder = ConditionEncoder(seen + own_seen, frequencies=frequencies, width=width)
        self.step = nn.Linear(EMBEDDING_DIM, width)
        self.layers = nn.ModuleList(_Layer(width) for _ in range(depth))
        self.norm = nn.LayerNorm(width)
        self.robot_last = nn.Linear(width, horizon * planned)
        self.object_last = nn.Linear(width, horizon * own_planned) if own_planned else None

    def denoise(self, x: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """Predicts ``[N, H, d]`` from sequences ``[N, H, d]`` (:meth:`Denoiser.denoise`)."""
        plan, *plans = (_take(x, columns).flatten(1) for columns in self.planned)
        seen, *views = (_take(condition, columns) for columns in self.seen)
        robot = self.robot_plan(plan) + self.robot_encoder(seen)
        objects = self.object_plan(torch.stack([torch.cat([plan, own], -1) for own in plans], 1))
        objects = objects + self.object_encoder(torch.stack([torch.cat([seen, own], -1) for own in views], 1))
        objects = objects + torch.stack([self.kinds[kind] for kind in self.kind_of])
        tokens = torch.cat([robot.unsqueeze(1), objects], 1) + self.step(step).unsqueeze(1)
        for layer in self.layers:
            tokens = layer(tokens)
        tokens = self.norm(tokens)
        denoised = [self.robot_last(tokens[:, 0])]
        if self.object_last is not None:
            denoised += self.object_last(tokens[:, 1:]).unbind(1)
        parts: list[tuple[slice, Tensor]] = []
        for columns, values in zip(self.planned, denoised, strict=False):  # a Diffusion Policy's objects have none
            sizes = [each.stop - each.start for each in columns]
            parts += zip(columns, values.unflatten(-1, (self.horizon, sum(sizes))).split(sizes, -1), strict=True)
        return torch.cat([part for _, part in sorted(parts, key=lambda each: each[0].start)], -1)


class _Layer(nn.Module):
    """A residual layer on tokens ``[N, 1 + n, w]``, the robot's first."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.own, self.shared = nn.Linear(width, 2 * width), nn.Linear(3 * width, 2 * width)
        self.last = nn.Linear(2 * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        x = self.norm(tokens)
        robot, objects = x[:, 0], x[:, 1:]
        shared = self.shared(torch.cat([robot, objects.mean(1), objects.amax(1)], -1))
        return tokens + self.last(F.silu(self.own(x) + shared.unsqueeze(1)))


def _others(total: int, owned: Sequence[Sequence[int]]) -> list[int]:
    """Returns the columns out of ``total`` that no object owns."""
    taken = set(chain.from_iterable(owned))
    return [column for column in range(total) if column not in taken]


def _slices(columns: Sequence[int]) -> list[slice]:
    """Returns ascending columns as slices, one per run."""
    starts = [column for column in columns if column - 1 not in columns]
    stops = [column + 1 for column in columns if column + 1 not in columns]
    return [slice(start, stop) for start, stop in zip(starts, stops, strict=True)]


def _take(values: Tensor, columns: Sequence[slice]) -> Tensor:
    return torch.cat([values[..., each] for each in columns] or [values[..., :0]], -1)
