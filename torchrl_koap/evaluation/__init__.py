# This source code is licensed under the MIT license found in the LICENSE file.
"""What a trained run is worth: rollouts, scores, diagnosis, and which demonstrations to label next."""

from torchrl_koap.evaluation.active_labelling import SuggestConfig, SuggestedLabels, rank_trajectories, suggest
from torchrl_koap.evaluation.inspection import InspectConfig, Inspection, inspect
from torchrl_koap.evaluation.policy_files import PolicyDescription, build_policy, save_policy
from torchrl_koap.evaluation.run import EvalConfig, TrainedRun, evaluate, load_policy, load_run

__all__ = [
    "EvalConfig",
    "InspectConfig",
    "Inspection",
    "PolicyDescription",
    "SuggestConfig",
    "SuggestedLabels",
    "TrainedRun",
    "build_policy",
    "evaluate",
    "inspect",
    "load_policy",
    "load_run",
    "rank_trajectories",
    "save_policy",
    "suggest",
]
