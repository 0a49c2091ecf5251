# This source code is licensed under the MIT license found in the LICENSE file.
"""What stands for the options of a study that are not given: the library's own, or a comparison of the paper."""

from __future__ import annotations

from typing import Any

PAPER_TASKS = ("avoiding", "aligning", "sorting", "po_sorting", "stacking_unobserved_joints")
# options of a Study by name, those of its sections in mappings of their own
USUAL: dict[str, Any] = {
    "methods": (
        *("koap", "koap_untrained", "koap_labelled_only", "linear", "dd", "vae", "lapo", "dp", "relabel", "nonlinear"),
        "pretrain",
    ),
    "labels": (0.01, 0.02, 0.05, 0.1, 0.25),
    "first_seed_only": (),
    "label_unit": "trajectory",
    "demonstrations": (1.0,),
    "seeds": 3,
}
_TABLE_1: dict[str, Any] = {
    "tasks": PAPER_TASKS,
    "methods": ("koap", "koap_paper", "koap_untrained", "linear_steps", "pca", "dd", "vae", "lapo", "dp"),
    "labels": (),
    "levels": (1, 2, 3, 4, 5),
    "first_seed_only": (3, 4),
    "label_unit": "window",
    "planner": {"network": "mlp", "width": 512, "batch_size": 256, "learning_rate": 1e-3},
    "controller": {"steps": 1000},
}
PRESETS: dict[str, dict[str, Any]] = {
    "table1": _TABLE_1,
    "table2": _TABLE_1
    | {
        "tasks": ("avoiding", "stacking_unobserved_joints"),
        "methods": (
            *("koap", "koap_paper", "koap_sgd", "koap_labelled_only", "koap_untrained", "nonlinear", "pretrain"),
            "relabel",
        ),
    },
    "demonstrations": {
        "tasks": ("avoiding",),
        "methods": ("koap", "koap_paper", "koap_untrained", "pca", "linear_steps", "dd"),
        "labels": (0.01,),
        "demonstrations": (0.1, 0.25, 0.5, 1.0),
        "controller": {"steps": 1000},
    },
    # a table that can be read, not one to be cited
    "quick": _TABLE_1
    | {
        "levels": (1,),
        "record": 48,
        "seeds": 1,
        "planner": _TABLE_1["planner"] | {"steps": 2000, "width": 256, "batch_size": 128},
        "controller": {"steps": 200},
        "evaluation": {"episodes": 10},
    },
}
