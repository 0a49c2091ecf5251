# This source code is licensed under the MIT license found in the LICENSE file.
"""What a trained run is worth: rollouts, scores, diagnosis, and which demonstrations to label next."""

from torchrl_koap.lookup import exports

# imported when first asked for: pictures need a reader of run directories, not TorchRL
__getattr__ = exports(
    __name__,
    {
        "EvalConfig": "torchrl_koap.evaluation.config",
        "InspectConfig": "torchrl_koap.evaluation.inspection",
        "Inspection": "torchrl_koap.evaluation.inspection",
        "PolicyDescription": "torchrl_koap.evaluation.policy_files",
        "SuggestConfig": "torchrl_koap.evaluation.active_labelling",
        "SuggestedLabels": "torchrl_koap.evaluation.active_labelling",
        "TrainedRun": "torchrl_koap.evaluation.trained_run",
        "build_policy": "torchrl_koap.evaluation.policy_files",
        "evaluate": "torchrl_koap.evaluation.closed_loop",
        "inspect": "torchrl_koap.evaluation.inspection",
        "load_policy": "torchrl_koap.evaluation.trained_run",
        "load_run": "torchrl_koap.evaluation.trained_run",
        "rank_trajectories": "torchrl_koap.evaluation.active_labelling",
        "save_policy": "torchrl_koap.evaluation.policy_files",
        "suggest": "torchrl_koap.evaluation.active_labelling",
    },
)

__all__ = [  # noqa: F822
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
