# This source code is licensed under the MIT license found in the LICENSE file.
"""Many runs: label-efficiency curves and the paper's tables."""

from torchrl_koap.lookup import exports

# imported when first asked for: pictures need a reader of run directories, not TorchRL
__getattr__ = exports(
    __name__,
    {
        "BenchConfig": "torchrl_koap.studies.paper_tables",
        "CurveConfig": "torchrl_koap.studies.label_efficiency",
        "run_bench": "torchrl_koap.studies.paper_tables",
        "run_curve": "torchrl_koap.studies.label_efficiency",
    },
)

__all__ = [  # noqa: F822
    "BenchConfig",
    "CurveConfig",
    "run_bench",
    "run_curve",
]
