# This source code is licensed under the MIT license found in the LICENSE file.
"""Defines a method: the network that it builds, its training phases, the data it may see, its defaults."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS, Execution, ExecutionConfig
from torchrl_koap.runs.config import ControllerConfig


class Batch(NamedTuple):
    """How training batches of a controller are drawn: the share of windows with labels, their number and length.

    If the share is None, labels do not matter. ``shortest`` windows, the shortest that a controller can read, have one
    frame that counts: every labelled window of a batch then shows another situation.
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


@dataclass(frozen=True)
class Phase:
    """One stage of a training: its loss, and the windows that it reads.

    Args:
        name (str): name in the log.
        loss (callable): ``loss(network)``, a ``LossModule`` whose ``loss_*`` entries are minimised and logged.
        windows (str): ``"all"`` (labelled or not), ``"mixed"`` (25 % of every batch have labels), ``"labelled"``, or
            ``"short"`` (the shortest possible, 75 % with labels).
        share (float): share of the controller's updates.

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
    """A way to learn a policy from few labels, with its own defaults.

    Its network, a :class:`~torchrl_koap.modules.InverseDynamics`, maps windows of states ``[*B, T, d]`` to actions
    ``[*B, T, act]``. It follows the plans of the planner that all controllers share. With ``closed_form``, its
    :meth:`~torchrl_koap.modules.InverseDynamics.fit_labels` is called once after all updates.

    A method that does not plan samples actions: :class:`~torchrl_koap.modules.DiffusionPolicy` shows its interface.

    Args:
        name (str): its name for ``--method``.
        title (str): its name in tables and legends.
        build (callable): ``build(task, columns, normalizers, preset)`` with the state columns that the controller
            reads (relative positions follow the last one), and ``state_normalizer`` and ``action_normalizer`` as
            keyword arguments in ``normalizers``; for a method that does not plan ``build(task, section)`` with the
            planner's section.
        phases (tuple of Phase): its training phases.
        closed_form (bool): its decoder is fitted in closed form at the end.
        sees (str): ``"all"`` windows, or only ``"labelled"`` ones, also for statistics of the states.
        plans (bool): it follows the plans of a planner; otherwise it is trained with the planner's number of updates.
        teacher (str): the method whose controller labels the unlabelled data first.
        presets (tuple of str): values of ``--preset`` that it can be built with; the first is its default.
        columns (str, optional): what its controller reads (:class:`~torchrl_koap.ControllerConfig`). Default: the
            task's.
        updates (int, optional): updates of its controller. Default: the task's.
        look_ahead (int, optional): planned frames that its controller reads ahead. Default: those of the preset.
        execution (mapping): fields of :class:`~torchrl_koap.modules.Execution` that it sets.
        fit (callable, optional): ``fit(controller, data, updates) -> dict``, in place of phases and closed form: fits a
            controller that is not an inverse dynamics model to flat data after the label budget was applied; returns
            numbers for the summary.
        phases_by_preset (mapping): phases of presets that are trained differently.

    Raises:
        ValueError: for a name that cannot be a folder name, two phases of one name, a phase ``"planner"``, an unknown
            default, or if nothing would be trained.

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
    look_ahead: int | None = None
    execution: Mapping[str, Any] = field(default_factory=dict)
    fit: Callable[[Any, Any, int], dict[str, Any]] | None = None
    phases_by_preset: Mapping[str, tuple[Phase, ...]] = field(default_factory=dict)

    def __post_init__(self):
        lookup(("all", "labelled"), self.sees, "kind of windows")
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.]*", self.name):
            raise ValueError(f"the name of a method must be letters, digits, '_' and later '.', got {self.name!r}")
        names = [phase.name for phase in self.phases]
        if len({"planner", *names}) <= len(names):  # logs and checkpoints have these names
            raise ValueError(f"phases of method {self.name!r} must have different names, not 'planner', got {names}")
        if not self.plans and len(names) != 1:
            raise ValueError(f"method {self.name!r} does not plan: it must have one phase, got {len(names)}")
        if self.fit is not None and (names or self.closed_form):
            raise ValueError(f"method {self.name!r}: fit excludes phases and closed_form")
        for preset in self.presets:
            lookup(PRESETS, preset, "preset")
        ControllerConfig(steps=self.updates, columns=self.columns)
        Execution().replaced(**self.execution)
        if not (names or self.closed_form or self.fit or self.phases_by_preset):
            raise ValueError(f"method {self.name!r} trains nothing: give it phases, closed_form or fit")

    def check_execution(self, asked: Execution | ExecutionConfig, usual: Execution) -> None:
        """Raises a ValueError if a method without plans is given plan options other than the usual ones."""
        for name in () if self.plans else ("strategy", "blend"):
            if getattr(asked, name) not in (None, getattr(usual, name)):
                raise ValueError(
                    f"{name} {getattr(asked, name)!r} was asked of method {self.name!r}, which samples actions and"
                    " executes chunks of them: it follows no plan"
                )
