# This source code is licensed under the MIT license found in the LICENSE file.
"""What a method is: the network that it builds, the phases that it is trained in, what it may see, its defaults."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.execution import Execution, ExecutionConfig


class Batch(NamedTuple):
    """How a batch of a controller's training is drawn: the share of windows with labels, their number and length.

    A share of None takes windows as they come. In the ``shortest`` windows that a controller can read one frame counts,
    so the labels of a batch are of as many situations as it has labelled windows.
    """

    labelled_share: float | None
    size: int = 256
    shortest: bool = False


BATCHES = {
    "all": Batch(None),
    "mixed": Batch(0.25),
    "labelled": Batch(1.0),
    "short": Batch(0.75, 512, shortest=True),
}
SEES = ("all", "labelled")


@dataclass(frozen=True)
class Phase:
    """One stage of a training: its loss, and the windows that it reads.

    Args:
        name (str): its name in the log.
        loss (callable): the loss of a network, a ``LossModule`` whose ``loss_*`` entries are minimised and logged.
        windows (str): ``"all"`` (labelled or not), ``"mixed"`` (25 % of every batch have labels), ``"labelled"``, or
            ``"short"`` (as short as can be, 75 % with labels).
        share (float): of the updates that a controller may have.

    Raises:
        ValueError: for an unknown kind of windows, or a share outside (0, 1].

    Examples:
        >>> from torchrl_koap.objectives import ActionLoss
        >>> from torchrl_koap.training import Phase
        >>> Phase("controller", ActionLoss, "labelled").share
        1.0
    """

    name: str
    loss: Callable[..., LossModule]
    windows: str = "all"
    share: float = 1.0

    def __post_init__(self):
        lookup(BATCHES, self.windows, "kind of windows")
        if not 0 < self.share <= 1:
            raise ValueError(f"the share of phase {self.name!r} must be in (0, 1], got {self.share}")


@dataclass(frozen=True)
class Method:
    """A way to get from few labels to a policy, with its own defaults.

    Its network maps windows of states ``[*B, T, d]`` to actions ``[*B, T, act]`` and follows the plans of the planner
    that all controllers share: a :class:`~torchrl_koap.modules.InverseDynamics`. With ``closed_form`` its
    :meth:`~torchrl_koap.modules.InverseDynamics.fit_labels` is called once after all updates.

    A method that does not plan samples actions: see :class:`~torchrl_koap.modules.DiffusionPolicy` for what it offers.

    Args:
        name (str): what ``--method`` calls it.
        title (str): what tables and legends call it.
        build (callable): ``build(task, columns, normalizers, preset)`` with the state columns that the controller
            reads (relative positions are counted on from the last one), and ``state_normalizer`` and
            ``action_normalizer`` as keyword arguments in ``normalizers``; of a method that does not plan
            ``build(task, section)`` with the planner's section.
        phases (tuple of Phase): how it is trained.
        closed_form (bool): its decoder is fitted in closed form at the end.
        sees (str): ``"all"`` windows, or ``"labelled"`` ones and nothing else, statistics of the states included.
        plans (bool): it follows the plans of a planner; otherwise it has the planner's updates instead of one.
        teacher (str): the method whose controller labels the rest of the data first.
        presets (tuple of str): values of ``--preset`` that it can be built with; the first is its own.
        columns (str, optional): what its controller reads, ``"robot"`` or ``"all"``. Default: the task's.
        updates (int, optional): of its controller. Default: the task's.
        execution (mapping): fields of :class:`~torchrl_koap.modules.Execution` that are its own.
        fit (callable, optional): ``fit(controller, data, updates) -> dict`` fits a controller that is no inverse
            dynamics to flat data after the label budget was applied, in place of phases and closed form; returns
            numbers for the summary.
        phases_by_preset (mapping): the phases of a preset that is trained otherwise.

    Raises:
        ValueError: for a name that cannot be a folder's, two phases of one name, or an unknown default.

    Examples:
        >>> from torchrl_koap.modules import LinearInverseDynamics
        >>> from torchrl_koap.training import Method
        >>> def build(task, columns, normalizers, preset):
        ...     return LinearInverseDynamics(len(columns), task.action_dim)
        >>> Method("my_ridge", "a ridge of mine", build, closed_form=True).plans
        True
    """

    name: str
    title: str
    build: Callable[..., TensorDictModuleBase]
    phases: tuple[Phase, ...] = ()
    closed_form: bool = False
    sees: str = "all"
    plans: bool = True
    teacher: str = ""
    presets: tuple[str, ...] = ("default",)
    columns: str | None = None
    updates: int | None = None
    execution: Mapping[str, Any] = field(default_factory=dict)
    fit: Callable[[Any, Any, int], dict[str, Any]] | None = None
    phases_by_preset: Mapping[str, tuple[Phase, ...]] = field(default_factory=dict)

    def __post_init__(self):
        lookup(SEES, self.sees, "kind of windows")
        if not re.fullmatch(r"[A-Za-z0-9_.]+", self.name):
            raise ValueError(f"the name of a method must be letters, digits, '_' and '.', got {self.name!r}")
        names = [phase.name for phase in self.phases]
        if len(set(names)) < len(names):
            raise ValueError(f"phases of method {self.name!r} need names of their own, got {names}")
        if not self.plans and len(names) != 1:
            raise ValueError(f"a policy is trained in one phase, method {self.name!r} has {len(names)}")
        if self.fit is not None and (names or self.closed_form):
            raise ValueError(f"method {self.name!r}: fit comes without phases or closed form")
        Execution().replaced(**self.execution)

    def phases_of(self, preset: str) -> tuple[Phase, ...]:
        """Returns how it is trained with a preset."""
        return self.phases_by_preset.get(preset, self.phases)

    def check_execution(self, asked: Execution | ExecutionConfig, usual: Execution) -> None:
        """Raises a ValueError for options of plans that are asked, other than usual, of a method that has none."""
        for name in () if self.plans else ("strategy", "blend"):
            if getattr(asked, name) not in (None, getattr(usual, name)):
                raise ValueError(
                    f"{name} {getattr(asked, name)!r} was asked of method {self.name!r}, which samples actions and"
                    " executes chunks of them: there is no plan to follow"
                )
