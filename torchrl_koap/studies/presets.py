# This source code is licensed under the MIT license found in the LICENSE file.
"""What stands for the fields of a study that are not given: the library's own, or a comparison of the paper."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.runs.config import ControllerConfig, PlannerConfig, RunConfig

PAPER_TASKS = ("avoiding", "aligning", "sorting", "po_sorting", "stacking_unobserved_joints")
_METHODS = (
    *("koap", "koap_untrained", "koap_labelled_only", "linear", "dd", "vae", "lapo", "dp", "relabel", "nonlinear"),
    "pretrain",
)


@dataclass(frozen=True)
class Preset:
    """Values of the fields of a :class:`~torchrl_koap.studies.Study`, and of some options of its sections.

    Attributes:
        methods, labels, levels, first_seed_only, label_unit, demonstrations, seeds, record: fields of the study.
        tasks: likewise; where there are none that of the data set, else "avoiding".
        planner: options of the planner; those that are None are left open.
        controller: options of the controller.
        precision: of every training.
        episodes: rollouts of every cell.

    Examples:
        >>> from torchrl_koap.studies.presets import PRESETS, Preset
        >>> Preset().labels, PRESETS["table1"].levels
        ((0.01, 0.02, 0.05, 0.1, 0.25), (1, 2, 3, 4, 5))
    """

    tasks: tuple[str, ...] = ()
    methods: tuple[str, ...] = _METHODS
    labels: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.25)
    levels: tuple[int, ...] = ()
    first_seed_only: tuple[int, ...] = ()
    label_unit: str = "trajectory"
    demonstrations: tuple[float, ...] = (1.0,)
    seeds: int = 3
    record: int | None = None
    planner: PlannerConfig = PlannerConfig()
    controller: ControllerConfig = ControllerConfig()
    precision: str = RunConfig.precision
    episodes: int = EvalConfig.episodes


_TABLE_1 = Preset(
    tasks=PAPER_TASKS,
    methods=("koap", "koap_paper", "koap_untrained", "linear_steps", "pca", "dd", "vae", "lapo", "dp"),
    labels=(),
    levels=(1, 2, 3, 4, 5),
    first_seed_only=(3, 4),
    label_unit="window",
    planner=PlannerConfig(network="mlp", width=512, batch_size=256, learning_rate=1e-3),
    controller=ControllerConfig(steps=1000),
    precision="auto",
)
PRESETS = {
    "table1": _TABLE_1,
    "table2": replace(
        _TABLE_1,
        tasks=("avoiding", "stacking_unobserved_joints"),
        methods=(
            *("koap", "koap_paper", "koap_sgd", "koap_labelled_only", "koap_untrained", "nonlinear", "pretrain"),
            "relabel",
        ),
    ),
    "demonstrations": Preset(
        tasks=("avoiding",),
        methods=("koap", "koap_paper", "koap_untrained", "pca", "linear_steps", "dd"),
        labels=(0.01,),
        demonstrations=(0.1, 0.25, 0.5, 1.0),
        controller=ControllerConfig(steps=1000),
    ),
    # a table that can be read, not one to be cited
    "quick": replace(
        _TABLE_1,
        levels=(1,),
        record=48,
        seeds=1,
        planner=replace(_TABLE_1.planner, steps=2000, width=256, batch_size=128),
        controller=ControllerConfig(steps=200),
        episodes=10,
    ),
}
