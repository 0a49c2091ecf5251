# This source code is licensed under the MIT license found in the LICENSE file.
"""A method from outside the package in one file: the labelled steps that look most alike are averaged.

Training learns how much every column of a window counts, so that the neighbours' actions predict the true ones
(``loss_neighbours``); the closed form then remembers all labelled windows.
"""

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import LossModule

from torchrl_koap.modules import InverseDynamics
from torchrl_koap.training import Method, Phase, register_method

BEFORE, AFTER = 1, 4  # frames of a window that are compared


class NearestNeighbours(InverseDynamics):
    """Actions of the remembered windows, weighted by ``softmax(-|weight (x - x_i)|^2)``."""

    num_past, num_window_frames = BEFORE, BEFORE + 1 + AFTER

    def __init__(self, state_dim, action_dim, **normalizers):
        super().__init__(**normalizers)
        width = (BEFORE + AFTER) * state_dim
        self.weight = nn.Parameter(torch.ones(width))
        self.register_buffer("windows", torch.zeros(0, width))
        self.register_buffer("actions", torch.zeros(0, action_dim))

    def features(self, state):
        """Displacements ``[*B, T, (BEFORE + AFTER) d]`` of the frames around each; a window ends in repeated frames."""
        state = self.normalize_state(state)
        frames = torch.arange(state.shape[-2], device=state.device)
        offsets = [offset for offset in range(-BEFORE, AFTER + 1) if offset]
        around = [state[..., (frames + offset).clamp(0, len(frames) - 1), :] - state for offset in offsets]
        return torch.cat(around, -1)

    def average(self, features, windows, actions, mask=None):
        """Weighted average of the actions ``[N, act]`` whose windows ``[N, w]`` are like ``features [*B, w]``."""
        distance = torch.cdist((features * self.weight).flatten(0, -2), windows * self.weight).square()
        if mask is not None:
            distance = distance.masked_fill(mask, torch.inf)
        return (torch.softmax(-distance, -1) @ actions).unflatten(0, features.shape[:-1])

    def predict(self, state, frames=None):
        """Normalised action of every frame."""
        features = self.features(state)
        features = features if frames is None else features[..., frames.start : frames.stop, :]
        return self.average(features, self.windows, self.actions)

    @torch.no_grad()
    def fit_labels(self, windows, mask, **_):
        """Remembers the windows of the labelled frames."""
        self.windows = self.features(windows["state"])[mask].clone()
        self.actions = self.normalize_action(windows["action"][mask], windows["state"][mask])
        return {"labels_used": int(mask.sum())}

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        for name in ("windows", "actions"):  # as many as were remembered
            if f"{prefix}{name}" in state_dict:
                setattr(self, name, torch.empty_like(state_dict[f"{prefix}{name}"]))
        super()._load_from_state_dict(state_dict, prefix, *rest)


class NeighboursLoss(LossModule):
    """Every labelled step of a batch is predicted by all others."""

    def __init__(self, controller):
        super().__init__()
        self.in_keys = ["state", "action", "has_action"]
        self.controller = controller

    def forward(self, tensordict):
        """Mean squared error in normalised units."""
        frames = slice(BEFORE, tensordict["state"].shape[-2] - AFTER)
        shown = tensordict["has_action"][:, frames, 0]
        features = self.controller.features(tensordict["state"])[:, frames][shown]
        actions = self.controller.normalize_action(
            tensordict["action"][:, frames][shown], tensordict["state"][:, frames][shown]
        )
        itself = torch.cdist(features, features) < 1e-6  # the same step may be in two windows
        itself &= ~itself.all(-1, keepdim=True)
        found = self.controller.average(features, features, actions, itself)
        return TensorDict({"loss_neighbours": (found - actions).square().mean()}, [])


def build(task, columns, normalizers, preset):
    """What ``--method nearest_neighbour`` trains."""
    return NearestNeighbours(len(columns), task.action_dim, **normalizers)


register_method(
    Method(
        "nearest_neighbour",
        "nearest labelled steps",
        build,
        (Phase("controller", NeighboursLoss, "labelled"),),
        closed_form=True,
    )
)
