# This source code is licensed under the MIT license found in the LICENSE file.
"""What the cells of a curve may be told besides their method and labels: planner, losses, what is read and executed.

``koap_paper`` is measured as published unless an option says otherwise: its controller reads the whole state.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.training.method import Method
from torchrl_koap.training.methods import get_method

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
        strategy: "feedback" (decode at every step) or "open_loop" (4 actions per plan, decoded at once), for all
            methods with a planner (default: the method's, feedback; open_loop for koap_paper, as published).
        blend: share of the distance between robot and plan that remains after each step; 0: plans as they are (default:
            the method's, 0.8; 0 for koap_paper).
        candidates: plans sampled whenever one is due (default: the method's, 1).
        controller_state: what controllers read, "robot" (the robot's own columns) or "all" (default: robot; all for
            koap_paper).
        denoiser: network of planner and dp, a name as of `koap train` (default: unet; `koap bench`: the wide mlp).
        denoiser_width: its hidden width.
        precision: of the matrix products of its training, a name as of `koap train` (default: float32; `koap bench`:
            auto).
        batch_size: windows per update of planner and dp (default: 128).
        planner_learning_rate: peak learning rate of planner and dp (default: 3e-3).
        policy_steps: updates of dp and vpt (default: as many as a planner's; `koap bench`: at most 8,000).
        policy_batch_size: windows per update of dp and vpt (default: as a planner).
        planner_seeds: number of planners, trained with seeds 0, 1, ...; a cell of seed s has planner s modulo that.

    Examples:
        >>> from torchrl_koap.studies.cell_options import CellOptions, training_options
        >>> training_options(CellOptions(controller_state="robot"), "koap_paper")
        {'controller_state': 'robot'}
    """

    strategy: str | None = None
    blend: float | None = None
    candidates: int | None = None
    controller_state: str | None = None
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
    chosen = planner_options(options)
    if not get_method(method).plans:
        return chosen | {
            name: getattr(options, own) for name, own in POLICY.items() if getattr(options, own) is not None
        }
    state = options.controller_state
    return chosen if state is None else chosen | {"controller_state": state}


def evaluation_options(options: CellOptions, method: str) -> dict[str, Any]:
    """How a cell of a method is rolled out, as keyword arguments of :class:`~torchrl_koap.evaluation.EvalConfig`.

    Args:
        options (CellOptions): what was asked for.
        method (str): name of the method; one without a planner executes chunks, and takes the candidates alone.

    Examples:
        >>> from torchrl_koap.studies.cell_options import CellOptions, evaluation_options
        >>> evaluation_options(CellOptions(strategy="open_loop", blend=0.0), "koap")["execution"].blend
        0.0
    """
    own, candidates = get_method(method), options.candidates
    if not own.plans:
        return {"execution": ExecutionConfig(candidates=candidates)}
    if options.strategy is None and own.execution.get("strategy") == "open_loop":
        candidates = None  # no plan is kept that several could be compared with
    return {"execution": ExecutionConfig(options.strategy, blend=options.blend, candidates=candidates)}


def check_cell_options(options: CellOptions, methods: list[Method]) -> None:
    """Refuses what no method, or not every method, of a curve could follow; before any work.

    Args:
        options (CellOptions): what was asked for.
        methods (list of Method): the methods of the curve.

    Raises:
        ValueError: for unknown names, numbers out of range, open loop asked of a policy that executes chunks, several
            candidates in open loop, or a coefficient that no method's loss has.
    """
    ExecutionConfig(options.strategy, blend=options.blend, candidates=options.candidates)
    if options.controller_state is not None:
        lookup(("robot", "all"), options.controller_state, "part of the state")
    chunked = [method.name for method in methods if not method.plans]
    if options.strategy == "open_loop" and chunked:
        raise ValueError(
            f"strategy 'open_loop' was asked of {', '.join(chunked)}: a policy of its own executes chunks of actions"
            " and has no other strategy; leave it out of --methods"
        )
    if options.strategy == "open_loop" and (options.candidates or 1) > 1:
        raise ValueError(
            "in open loop no plan is kept that several candidates could be compared with: strategy 'open_loop' goes"
            f" with 1 candidate, got {options.candidates}"
        )
    for name in ("candidates", "planner_seeds", "batch_size", *POLICY.values()):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(options, name)}")
