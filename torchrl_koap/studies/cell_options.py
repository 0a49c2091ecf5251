# This source code is licensed under the MIT license found in the LICENSE file.
"""What the cells of a curve may be told besides their method and labels: planner, losses, what is read and executed.

``koap_paper`` is measured as published unless an option says otherwise: its controller reads the whole state, and 4
actions of every chunk are executed in open loop, from plans as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.plan_then_control import EXECUTIONS
from torchrl_koap.training.method import COEFFICIENTS, Method, loss_coefficients
from torchrl_koap.training.methods import get_method

# how a method is measured where no option says otherwise; what is not named is as for any other method
PUBLISHED = {"koap_paper": {"controller_state": "all", "execution": "open_loop", "joining": 0.0, "candidates": 1}}
PLANNER = (
    "denoiser",
    "denoiser_width",
    "precision",
    "batch_size",
    "planner_learning_rate",
)
# options of methods that train a network of their own instead of sharing a planner, by what training calls them
POLICY = {"steps": "policy_steps", "batch_size": "policy_batch_size"}


@dataclass(kw_only=True)
class CellOptions:
    """Options of every cell; None leaves a method as it is measured by default.

    Attributes:
        execution: "feedback" (decode at every step) or "open_loop" (4 actions per plan, decoded at once), for all
            methods with a planner (default: feedback; open_loop for koap_paper, as published).
        joining: share of the distance between state and plan that is left after each step, `--blend-decay` of
            `koap eval`; 0: plans as they are (default: 0.8; 0 for koap_paper).
        candidates: plans sampled whenever one is due (default: 1; always 1 for koap_paper in open loop).
        controller_state: what controllers read, "robot" (the robot's own columns) or "all" (default: robot; all for
            koap_paper).
        koopman_coeff: weight of the Koopman term in the loss of every method that has one (default: 1).
        action_coeff: weight of the action term in the loss of KOAP's jointly trained methods (default: 1).
        denoiser: network of planner and dp, a name as of `koap train` (default: unet; `koap bench`: the wide mlp).
        denoiser_width: its hidden width.
        precision: of the matrix products of its training, a name as of `koap train` (default: float32; `koap bench`:
            auto).
        batch_size: windows per update of planner and dp (default: 128).
        planner_learning_rate: peak learning rate of planner and dp (default: 3e-3).
        policy_steps: updates of dp and dp_relabel (default: as many as a planner's; `koap bench`: at most 8,000).
        policy_batch_size: windows per update of dp and dp_relabel (default: as a planner).
        planner_seeds: number of planners, trained with seeds 0, 1, ...; a cell of seed s has planner s modulo that.

    Examples:
        >>> from torchrl_koap.studies.cell_options import CellOptions, training_options
        >>> training_options(CellOptions(koopman_coeff=0.5), "koap_paper")
        {'koopman_coeff': 0.5, 'controller_state': 'all'}
    """

    execution: str | None = None
    joining: float | None = None
    candidates: int | None = None
    controller_state: str | None = None
    koopman_coeff: float | None = None
    action_coeff: float | None = None
    denoiser: str | None = None
    denoiser_width: int | None = None
    precision: str | None = None
    batch_size: int | None = None
    planner_learning_rate: float | None = None
    policy_steps: int | None = None
    policy_batch_size: int | None = None
    planner_seeds: int = 1


OPTION_NAMES = tuple(field.name for field in fields(CellOptions))


def planner_options(options: CellOptions) -> dict[str, Any]:
    """What of the options a planner, or a policy of its own, is trained with (:class:`TrainConfig`)."""
    return {name: getattr(options, name) for name in PLANNER if getattr(options, name) is not None}


def training_options(options: CellOptions, method: str) -> dict[str, Any]:
    """What of the options a cell of a method is trained with, as keyword arguments of :class:`TrainConfig`.

    Args:
        options (CellOptions): what was asked for.
        method (str): name of the method.
    """
    has = loss_coefficients(get_method(method))
    chosen = planner_options(options) | {
        name: getattr(options, name) for name in COEFFICIENTS if name in has and getattr(options, name) is not None
    }
    if not get_method(method).has_planner:
        chosen |= {name: getattr(options, own) for name, own in POLICY.items() if getattr(options, own) is not None}
    state = _chosen(options, method, "controller_state")
    return chosen if state is None else chosen | {"controller_state": state}


def evaluation_options(options: CellOptions, method: str) -> dict[str, Any]:
    """How a cell of a method is rolled out, as keyword arguments of :class:`~torchrl_koap.evaluation.EvalConfig`.

    Args:
        options (CellOptions): what was asked for.
        method (str): name of the method; one without a planner executes chunks, and takes the candidates alone.

    Examples:
        >>> from torchrl_koap.studies.cell_options import CellOptions, evaluation_options
        >>> evaluation_options(CellOptions(), "koap"), evaluation_options(CellOptions(), "koap_paper")
        ({}, {'execution': 'open_loop', 'blend_decay': 0.0, 'candidates': 1})
    """
    names = {"execution": "execution", "joining": "blend_decay", "candidates": "candidates"}
    if not get_method(method).has_planner:
        names = {"candidates": "candidates"}
    chosen = {written: _chosen(options, method, name) for name, written in names.items()}
    if chosen.get("execution") == "open_loop" and options.execution is None:
        chosen["candidates"] = 1  # no plan is kept that several could be compared with
    return {name: value for name, value in chosen.items() if value is not None}


def _chosen(options: CellOptions, method: str, name: str) -> Any:
    asked = getattr(options, name)
    return PUBLISHED.get(method, {}).get(name) if asked is None else asked


def check_cell_options(options: CellOptions, methods: list[Method]) -> None:
    """Refuses what no method, or not every method, of a curve could follow; before any work.

    Args:
        options (CellOptions): what was asked for.
        methods (list of Method): the methods of the curve.

    Raises:
        ValueError: for unknown names, numbers out of range, open loop asked of a policy that executes chunks, several
            candidates in open loop, or a coefficient that no method's loss has.
    """
    if options.execution is not None:
        lookup(EXECUTIONS, options.execution, "execution")
    if options.controller_state is not None:
        lookup(("robot", "all"), options.controller_state, "part of the state")
    chunked = [method.name for method in methods if not method.has_planner]
    if options.execution == "open_loop" and chunked:
        raise ValueError(
            f"execution 'open_loop' was asked of {', '.join(chunked)}: a policy of its own executes chunks of actions"
            " and has no other execution; leave it out of --methods"
        )
    if options.execution == "open_loop" and (options.candidates or 1) > 1:
        raise ValueError(
            "in open loop no plan is kept that several candidates could be compared with: execution 'open_loop' goes"
            f" with 1 candidate, got {options.candidates}"
        )
    if options.joining is not None and not 0 <= options.joining < 1:
        raise ValueError(f"joining must be in [0, 1), got {options.joining}")
    for name in ("candidates", "planner_seeds", "batch_size", *POLICY.values()):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(options, name)}")
    for name in COEFFICIENTS:
        value = getattr(options, name)
        if value is None:
            continue
        if value < 0:
            raise ValueError(f"{name} must be >= 0, got {value}")
        if not any(name in loss_coefficients(method) for method in methods):
            raise ValueError(f"{name} was given, but no loss of {', '.join(m.name for m in methods)} has it")
