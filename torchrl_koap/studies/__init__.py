# This source code is licensed under the MIT license found in the LICENSE file.
"""Many runs: label-efficiency curves and the paper's tables."""

from torchrl_koap.studies.label_efficiency import CurveConfig, run_curve
from torchrl_koap.studies.paper_tables import BenchConfig, run_bench

__all__ = ["BenchConfig", "CurveConfig", "run_bench", "run_curve"]
