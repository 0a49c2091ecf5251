# This source code is licensed under the MIT license found in the LICENSE file.
"""What a method is: the network that it builds, the phases that it is trained in, and what it may see."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.objectives import LossModule

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import Execution

KINDS = ("controller", "policy")
# share of every batch that has labels; None: as it comes
LABELLED_SHARES = {"all": None, "mixed": 0.25, "labelled": 1.0}
COEFFICIENTS = ("koopman_coeff", "action_coeff")  # of losses, that a training may be given


@dataclass(frozen=True)
class Phase:
    """A stretch of training.

    Args:
        name (str): its name in the log.
        loss (callable): the loss of a network, a ``LossModule`` whose ``loss_*`` entries are minimised and logged.
        windows (str): ``"all"`` (labelled or not), ``"mixed"`` (a quarter of every batch has labels) or ``"labelled"``.
        share (float): of the updates that a controller may have.
        coefficients (tuple of str): those of :data:`COEFFICIENTS` that ``loss`` takes as keyword arguments.

    Raises:
        ValueError: for an unknown kind of windows, or a share outside (0, 1].

    Examples:
        >>> from torchrl_koap.objectives import ActionLoss
        >>> from torchrl_koap.training import Phase
        >>> Phase("controller", ActionLoss, "labelled").share
        1.0
    """

    name: str
    loss: Callable[[Any], LossModule]
    windows: str = "all"
    share: float = 1.0
    coefficients: tuple[str, ...] = ()

    def __post_init__(self):
        lookup(LABELLED_SHARES, self.windows, "kind of windows")
        if not 0 < self.share <= 1:
            raise ValueError(f"the share of phase {self.name!r} must be in (0, 1], got {self.share}")


@dataclass(frozen=True)
class Method:
    """A way to get from few labels to a policy.

    A ``"controller"`` maps windows of states ``[*B, T, d]`` to actions ``[*B, T, act]`` and follows the plans of the
    planner that all controllers share: a :class:`~torchrl_koap.modules.InverseDynamics`, whose docstring lists what is
    asked of one. With ``closed_form`` its ``fit_labels`` is called once after all updates, with windows of which frame
    ``num_past`` counts where ``mask`` is True; it returns numbers for the summary.

    A ``"policy"`` has no planner beside it: see :class:`~torchrl_koap.modules.DiffusionPolicy` for what it offers.

    Args:
        name (str): what ``--method`` calls it.
        title (str): what tables and legends call it.
        build (callable): for a controller ``build(state_dim, action_dim, normalizers, options)`` with the keyword
            arguments ``state_normalizer`` and ``action_normalizer`` in ``normalizers`` and the ``controller`` entry of
            ``config.json`` as ``options``; for a policy ``build(state_dim, action_dim, features, options)`` with the
            task's relative positions, or None, and the ``planner`` entry.
        phases (tuple of Phase): how it is trained.
        kind (str): ``"controller"``, or ``"policy"``, which has the planner's updates instead of a planner.
        closed_form (bool): its decoder is fitted in closed form at the end.
        labelled_only (bool): it sees labelled windows and nothing else, statistics of the states included.
        teacher (str): the method whose controller labels the rest of the data first.
        other_decoder (str): the same method with the other way to get a decoder.
        presets (tuple of str): values of ``--preset`` that it can be built with; the first is its own.
        columns (callable, optional): ``columns(task) -> dict``, for a controller that is no inverse dynamics: what
            ``build`` finds under ``"columns"`` of the options.
        fit (callable, optional): ``fit(controller, data, updates) -> dict`` fits such a controller to flat data after
            the label budget was applied, in place of phases and closed form; returns numbers for the summary.
        knows_commands (bool): it is told the last command at every labelled step, which is a recording's as the action
            is (:func:`~torchrl_koap.training.command_model.with_label_commands`).
        execution (dict): fields of :class:`~torchrl_koap.modules.Execution` that it is executed with unless others are
            asked for.

    Raises:
        ValueError: for an unknown kind, a name that cannot be a folder's, or two phases of one name.

    Examples:
        >>> from torchrl_koap.modules import LinearInverseDynamics
        >>> from torchrl_koap.training import Method
        >>> def build(state_dim, action_dim, normalizers, options):
        ...     return LinearInverseDynamics(state_dim, action_dim)
        >>> Method("my_ridge", "a ridge of mine", build, closed_form=True).has_planner
        True
    """

    name: str
    title: str
    build: Callable[..., TensorDictModuleBase]
    phases: tuple[Phase, ...] = ()
    kind: str = "controller"
    closed_form: bool = False
    labelled_only: bool = False
    teacher: str = ""
    other_decoder: str = ""
    presets: tuple[str, ...] = ("default",)
    columns: Callable[[Any], dict[str, Any]] | None = None
    fit: Callable[[Any, Any, int], dict[str, Any]] | None = None
    knows_commands: bool = False
    execution: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        lookup(KINDS, self.kind, "kind of method")
        if not re.fullmatch(r"[A-Za-z0-9_.]+", self.name):
            raise ValueError(f"the name of a method must be letters, digits, '_' and '.', got {self.name!r}")
        names = [phase.name for phase in self.phases]
        if len(set(names)) < len(names):
            raise ValueError(f"phases of method {self.name!r} need names of their own, got {names}")
        Execution().replaced(**self.execution)
        if (self.fit is None) != (self.columns is None) or (self.fit is not None and (names or self.closed_form)):
            raise ValueError(f"method {self.name!r}: columns and fit come together, and without phases or closed form")
        if self.kind == "policy" and len(names) != 1:
            raise ValueError(f"a policy is trained in one phase, method {self.name!r} has {len(names)}")

    @property
    def has_planner(self) -> bool:
        """Whether a planner is trained beside it."""
        return self.kind != "policy"


def loss_coefficients(method: Method) -> set[str]:
    """Names of the coefficients that the losses of a method take, such as ``"koopman_coeff"``.

    Args:
        method (Method): the method.

    Examples:
        >>> from torchrl_koap.training.method import loss_coefficients
        >>> from torchrl_koap.training.methods import get_method
        >>> sorted(loss_coefficients(get_method("koap_paper"))), loss_coefficients(get_method("dd"))
        (['action_coeff', 'koopman_coeff'], set())
    """
    return {name for phase in method.phases for name in phase.coefficients}


def normalizers_of(state: nn.Module, action: nn.Module) -> Mapping[str, nn.Module]:
    """The two normalisers as the keyword arguments that every network takes.

    Args:
        state (nn.Module): maps raw states ``[*B, d]`` to the network's units.
        action (nn.Module): maps raw actions ``[*B, act]`` to them.

    Returns:
        dict: ``state_normalizer`` and ``action_normalizer``.
    """
    return {"state_normalizer": state, "action_normalizer": action}
