# This source code is licensed under the MIT license found in the LICENSE file.
"""Options of how plans become actions; they are saved with a run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from torchrl_koap.lookup import lookup

STRATEGIES = ("feedback", "open_loop", "oracle")


@dataclass(frozen=True)
class Execution:
    """Holds the options of how plans become actions.

    ::

        step            0          1          2          3          4
        plan made at    0                                           4
        feedback        a(x_0,P)   a(x_1,P)   a(x_2,P)   a(x_3,P)   a(x_4,P')
        open_loop       a_0(x_0,P) a_1(x_0,P) a_2(x_0,P) a_3(x_0,P) a_0(x_4,P')

    ``"open_loop"`` is the paper's strategy. Gain and lead are applied after the limits.

    Args:
        strategy, ..., limits: the attributes of :class:`ExecutionConfig`, each with a default.

    Raises:
        ValueError: for an unknown strategy, or a number out of range.

    Examples:
        >>> from torchrl_koap.modules import Execution
        >>> Execution().replaced(strategy="open_loop", blend=None) == Execution("open_loop", blend=0.8)
        True
    """

    strategy: str = "feedback"
    replan_interval: int = 4
    blend: float = 0.8
    lead: float = 0.0
    gain: float = 1.0
    temperature: float = 1.0
    candidates: int = 1
    limits: float = 0.5

    def __post_init__(self):
        lookup(STRATEGIES, self.strategy, "strategy")
        for name in ("replan_interval", "candidates"):
            value = vars(self)[name]
            if type(value) is not int or value < 1:
                raise ValueError(f"{name} must be an integer >= 1, got {value!r}")
        if not 0 <= self.blend < 1:
            raise ValueError(f"blend must be in [0, 1), got {self.blend}")
        if not 0 <= self.lead < math.inf:
            raise ValueError(f"lead must be a number >= 0, got {self.lead}")
        if not 0 < self.gain < math.inf:
            raise ValueError(f"gain must be a number above 0, got {self.gain}")
        if not 0 <= self.temperature <= 1:
            raise ValueError(f"temperature must be in 0..1, got {self.temperature}")
        if not self.limits >= 0:
            raise ValueError(f"limits must be a number >= 0, or infinity, got {self.limits}")

    def replaced(self, **asked: Any) -> Execution:
        """Returns a copy with some fields replaced; ``None`` keeps a field. Raises a ValueError for unknown fields."""
        for name in asked:
            lookup(asdict(self), name, "option of an execution")
        return replace(self, **{name: value for name, value in asked.items() if value is not None})


@dataclass(frozen=True)
class ExecutionConfig:
    """Options of an :class:`Execution`; None selects the default of the method, the task or the library.

    Attributes:
        strategy: "feedback" (decode at every step), "open_loop" (decode once per plan) or "oracle" (inverse dynamics of
            the simulator, which follow plans closely within the arm's reach; remaining failures are mostly the
            planner's).
        replan_interval: control steps per plan (default with feedback: the steps in 0.1 s, at least 4 and at most 10,
            or 7 if the controller looks 8 steps ahead).
        blend: share of the distance between robot and plan that remains after each step; 0: plans are not shifted.
        lead: largest distance of the command from the robot along each axis, in the units of the actions; 0: no limit.
        gain: factor of actions that are changes of a command; above 1 the robot moves faster than planned.
        temperature: factor of the noise that plans are sampled from, 0 to 1. Below 1 plans are more precise and vary
            less.
        candidates: plans that are sampled together; one of the two that are nearest to each other is executed. With 3
            or more, plans between two routes become rare, and so do rare routes.
        limits: commands stay in the demonstrated range, widened on each side by this share of it; inf: no limit.

    Raises:
        ValueError: as :class:`Execution`.

    Examples:
        >>> from torchrl_koap.modules import Execution, ExecutionConfig
        >>> ExecutionConfig(replan_interval=8).on(Execution(strategy="open_loop")).replan_interval
        8
    """

    strategy: str | None = None
    replan_interval: int | None = None
    blend: float | None = None
    lead: float | None = None
    gain: float | None = None
    temperature: float | None = None
    candidates: int | None = None
    limits: float | None = None

    def __post_init__(self):
        self.on(Execution())

    def on(self, default: Execution) -> Execution:
        """Returns ``default`` with the options that are given (not None) replaced."""
        return default.replaced(**asdict(self))
