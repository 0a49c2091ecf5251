# This source code is licensed under the MIT license found in the LICENSE file.
"""Label budgets: which steps keep their action label, and which trajectories are used.

Labels outside the budget become NaN, so code that reads them by mistake produces NaN losses. Some tasks observe the
last command. Its differences are the actions, so those columns become NaN too (:func:`hide_commands`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_HALF_UP, Context, Decimal
from typing import Literal, get_args

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data.trajectories import labelled_episodes, mark_labels, trajectory_lengths
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import HISTORY, WINDOW

Unit = Literal["trajectory", "window", "transition"]


@dataclass(frozen=True)
class LabelReport:
    """Counts of what a label budget selected."""

    unit: str  # of the draw
    selected_units: int
    total_units: int
    labelled_transitions: int  # distinct transitions that keep their action
    total_transitions: int
    trajectories_touched: int  # with at least one label
    total_trajectories: int
    seed: int  # of the draw
    available_units: int  # with a label in the input data, so they could be drawn
    available_transitions: int  # with a label in the input data
    commands_told: int = 0  # labelled transitions whose command is NaN in the observation, but kept beside the label

    def __str__(self) -> str:
        share, units = self.labelled_transitions / self.total_transitions, plural_of(self.unit)
        had = ""
        if self.available_transitions < self.total_transitions:
            had = f"; the data came with {self.available_transitions} labels, on {self.available_units} {units}"
        return (
            f"{self.selected_units} of {self.total_units} {units} drawn: {self.labelled_transitions} of"
            f" {self.total_transitions} transitions labelled ({share:.2%}),"
            f" {self.trajectories_touched} of {self.total_trajectories} trajectories touched{had}"
        )


@dataclass(frozen=True, kw_only=True)
class LabelBudget:
    """Keeps the labels of a few trajectories, windows or single transitions, and hides all others.

    The draw depends only on the seed. With the same seed a larger budget contains every smaller one.

    Units without any label are skipped; partly labelled units keep their labels. Fractions refer to all units, labelled
    or not, except ``1.0``, which draws every unit that has a label.

    * ``"trajectory"``: whole demonstrations, as robots record them.
    * ``"window"``: the unit of the first public code. Windows of 16 steps are drawn without replacement from all
      trajectories; the 14 inner frames of each keep their label.
    * ``"transition"``: single steps.

    Args:
        fraction (float, optional): share of the units in (0, 1], rounded half up to a whole number.
        count (int, optional): number of units.
        episodes (iterable of int, optional): these trajectories instead of a draw, such as those that ``koap suggest``
            names. If none of the three is given, all labels are kept.
        unit (str): ``"trajectory"``, ``"window"`` or ``"transition"``.
        seed (int): seed of the draw.

    Raises:
        ValueError: if an argument is out of range, or several of the first three are given.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import LabelBudget, flatten_trajectories
        >>> data = flatten_trajectories([torch.rand(31, 4)] * 10, [torch.rand(30, 2)] * 10)
        >>> labelled, report = LabelBudget(fraction=0.2).apply(data)
        >>> print(report)
        2 of 10 trajectories drawn: 60 of 300 transitions labelled (20.00%), 2 of 10 trajectories touched
        >>> int(labelled["has_action"].sum()), int(labelled["action"].isnan().all(-1).sum())
        (60, 240)
    """

    fraction: float | None = None
    count: int | None = None
    episodes: Iterable[int] | None = None
    unit: Unit = "trajectory"
    seed: int = 0

    def __post_init__(self):
        given = [name for name in ("fraction", "count", "episodes") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"labels: give one of fraction, count and episodes, got {' and '.join(given)}")
        lookup(get_args(Unit), self.unit, "unit of labels")
        if self.fraction is not None and not (
            isinstance(self.fraction, (int, float, np.number)) and 0 < self.fraction <= 1
        ):
            raise ValueError(f"labels: fraction must be in (0, 1], got {self.fraction!r}")
        if self.count is not None and not (isinstance(self.count, (int, np.integer)) and self.count >= 1):
            raise ValueError(f"labels: count must be a whole number of at least 1, got {self.count!r}")
        if self.episodes is not None:
            chosen = tuple(int(episode) for episode in self.episodes)
            if not chosen or len(set(chosen)) < len(chosen):
                raise ValueError(f"labels: episodes must be one or more different numbers, got {list(chosen)}")
            if self.unit != "trajectory":
                raise ValueError(f"labels: episodes are trajectories, got unit {self.unit!r}")
            object.__setattr__(self, "episodes", chosen)

    def apply(
        self, data: TensorDictBase, *, command: slice | None = None, tell_commands: bool = False
    ) -> tuple[TensorDictBase, LabelReport]:
        """Hides all labels outside the budget.

        Args:
            data (TensorDictBase): flat data ``[N]``; not changed. Without ``has_action``, actions that are NaN
                throughout are taken to be missing (:func:`mark_labels`).
            command (slice, optional): observation columns that repeat the command, for :func:`hide_commands`.
            tell_commands (bool): labelled steps keep the command that their action changes in ``label_command``. About
                hidden actions this reveals only their sum between two labels.

        Returns:
            tuple: a copy of the data within the budget, and the :class:`LabelReport`.

        Raises:
            ValueError: if there are no labels, or the budget selects none or more than there are.
        """
        data = data if keys.HAS_ACTION in data.keys() else mark_labels(data)
        keys.validate(data, command=command)
        available = data.get(keys.HAS_ACTION).squeeze(-1).cpu().numpy()
        if not available.any():
            raise ValueError(f"none of the {len(available)} steps has an action: there are no labels to select")
        lengths = trajectory_lengths(data).cpu().numpy()
        starts = np.cumsum(lengths) - lengths
        first, end = self._units(starts, lengths)
        before = np.concatenate([[0], available.cumsum()])  # number of labels before every step
        usable = before[end] > before[first]
        if self.episodes is None:
            order = np.random.default_rng(self.seed).permutation(len(first))
            chosen = order[usable[order]][: self._number_of(len(first), int(usable.sum()))]
        else:
            chosen = _positions(data.get(keys.EPISODE).cpu().numpy()[starts], usable, tuple(self.episodes))
        kept = np.zeros_like(available)
        for begin, stop in zip(first[chosen], end[chosen], strict=True):
            kept[begin:stop] = available[begin:stop]

        has_action = torch.from_numpy(kept).to(data.get(keys.ACTION).device).unsqueeze(-1)
        labelled, commands_kept = data.clone().set(keys.HAS_ACTION, has_action), 0
        labelled.set(keys.ACTION, torch.where(has_action, data.get(keys.ACTION), math.nan))
        last = labelled.pop(keys.LABEL_COMMAND, None)
        if command is not None:
            labelled = hide_commands(labelled, command)
            if tell_commands:
                last = data.get(keys.OBSERVATION)[:, command] if last is None else last
                labelled.set(keys.LABEL_COMMAND, torch.where(has_action, last, math.nan))
                blank = labelled.get(keys.OBSERVATION)[:, command].isnan().any(-1, keepdim=True)
                commands_kept = int((blank & has_action).sum())
        touched = np.add.reduceat(kept, starts, dtype=np.int64) > 0
        report = LabelReport(
            unit=self.unit,
            selected_units=len(chosen),
            total_units=len(first),
            labelled_transitions=int(kept.sum()),
            total_transitions=len(kept),
            trajectories_touched=int(touched.sum()),
            total_trajectories=len(lengths),
            seed=self.seed,
            available_units=int(usable.sum()),
            available_transitions=int(available.sum()),
            commands_told=commands_kept,
        )
        return labelled, report

    def _units(self, starts: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the first step whose label each unit keeps, and the end (exclusive), both int ``[units]``."""
        if self.unit == "trajectory":
            return starts, starts + lengths
        if self.unit == "transition":
            steps = np.arange(lengths.sum())
            return steps, steps + 1
        counts = np.maximum(lengths - WINDOW + 1, 0)
        if not counts.any():
            raise ValueError(f"no trajectory is as long as a window of {WINDOW} steps (longest: {lengths.max()})")
        windows = np.concatenate([start + np.arange(count) for start, count in zip(starts, counts, strict=True)])
        return windows + HISTORY - 1, windows + WINDOW - 1

    def _number_of(self, total: int, usable: int) -> int:
        """Returns how many units to draw from ``total``, of which ``usable`` have a label."""
        plural = plural_of(self.unit)
        if self.count is None and self.fraction in (None, 1):
            return usable
        if self.count is not None:
            number = int(self.count)
        else:  # decimal arithmetic: 0.145 of 100 is 14.5, not 14.499999999999998
            number = int((Decimal(repr(float(self.fraction))) * total).to_integral_value(ROUND_HALF_UP))
        if number == 0:
            least = Context(prec=4, rounding=ROUND_CEILING).divide(Decimal("0.5"), Decimal(total))
            raise ValueError(
                f"a label fraction of {self.fraction} selects none of the {total} {plural};"
                f" the smallest fraction that selects one is {least}"
            )
        if number > usable:
            have = f"there are {total}" if usable == total else f"only {usable} of {total} have a label"
            raise ValueError(f"{number} labelled {plural} asked for, {have}")
        return number


def _positions(present: np.ndarray, usable: np.ndarray, wanted: tuple[int, ...]) -> np.ndarray:
    """Returns the positions of the trajectories with the ``wanted`` numbers."""
    absent = sorted(set(wanted) - set(present.tolist()))
    if absent:
        raise ValueError(f"there are no episodes {absent} to label; the data have {present.min()} to {present.max()}")
    unlabelled = sorted(set(wanted) - set(present[usable].tolist()))
    if unlabelled:
        order = "episodes are counted in the order of file names: added or renamed files change their numbers"
        raise ValueError(f"episodes {unlabelled} are to be labelled, but the data hold no actions for them; {order}")
    return np.flatnonzero(np.isin(present, wanted))


def hide_commands(data: TensorDictBase, command: slice) -> TensorDictBase:
    """Sets the command columns of every trajectory with a hidden action to NaN, in a copy of flat data ``[N]``.

    The difference of two commands is the sum of the actions between them, so only fully labelled trajectories keep
    theirs. Changes ``observation`` and ``("next", "observation")``; ``state`` never holds commands.
    """
    episode = data.get(keys.EPISODE)
    rows = torch.isin(episode, episode[~data.get(keys.HAS_ACTION).squeeze(-1)])
    result = data.clone()
    for key in (keys.OBSERVATION, keys.NEXT_OBSERVATION):
        value = result.get(key)
        value[:, command] = torch.where(rows.unsqueeze(-1), math.nan, value[:, command])
    return result


def subsample_trajectories(data: TensorDictBase, fraction: float) -> TensorDictBase:
    """Drops whole trajectories without a label until a share of all trajectories is left.

    Trajectories with a label always stay; a larger share contains every smaller one. Apply the label budget to the data
    ``[N]`` first. The order of the trajectories stays.

    Raises:
        ValueError: if the share is outside (0, 1], or smaller than that of the trajectories with labels.
    """
    if not 0 < fraction <= 1:
        raise ValueError(f"the share of trajectories to use must be in (0, 1], got {fraction}")
    episodes = data.get(keys.EPISODE).unique_consecutive()
    number = math.floor(fraction * len(episodes) + 0.5)
    labelled = torch.isin(episodes, labelled_episodes(data)).cpu()
    if number < max(int(labelled.sum()), 1):
        raise ValueError(
            f"a share of {fraction} of the trajectories keeps {number} of {len(episodes)},"
            f" but {int(labelled.sum())} have labels"
        )
    if number == len(episodes):
        return data
    order = torch.randperm(len(episodes), generator=torch.Generator().manual_seed(0))
    order = torch.cat([order[labelled[order]], order[~labelled[order]]])
    return data[torch.isin(data.get(keys.EPISODE), episodes[order[:number].to(episodes.device)])]


def plural_of(unit: str) -> str:
    """Returns the plural of a unit of labels; "" stands for any unit."""
    return {"trajectory": "trajectories", "": "labels"}.get(unit, f"{unit}s")
