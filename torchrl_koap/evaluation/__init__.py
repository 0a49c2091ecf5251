# This source code is licensed under the MIT license found in the LICENSE file.
"""How well a trained run does: rollouts, scores, diagnosis, and which demonstrations to label next."""

from torchrl_koap.lookup import exports

# imported when first asked for: pictures need a reader of run directories, not TorchRL
_OFFERS = {
    "active_labelling": ("SuggestConfig", "rank_trajectories", "suggest"),
    "closed_loop": ("evaluate",),
    "config": ("EvalConfig",),
    "inspection": ("InspectConfig", "inspect"),
    "policies": ("load_policy",),
}
__getattr__, __all__ = exports(__name__, _OFFERS)
