# This source code is licensed under the MIT license found in the LICENSE file.
"""How well a trained run does: rollouts, scores, diagnosis, and which demonstrations to label next."""

from torchrl_koap.lookup import exports

# imported when first asked for: pictures need a reader of run directories, not TorchRL
_MODULES = {
    "EvalConfig": "torchrl_koap.evaluation.config",
    "InspectConfig": "torchrl_koap.evaluation.inspection",
    "SuggestConfig": "torchrl_koap.evaluation.active_labelling",
    "evaluate": "torchrl_koap.evaluation.closed_loop",
    "inspect": "torchrl_koap.evaluation.inspection",
    "load_policy": "torchrl_koap.evaluation.policies",
    "rank_trajectories": "torchrl_koap.evaluation.active_labelling",
    "suggest": "torchrl_koap.evaluation.active_labelling",
}
__getattr__ = exports(__name__, _MODULES)

__all__ = list(_MODULES)
