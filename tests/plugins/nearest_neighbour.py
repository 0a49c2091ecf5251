# This source code is licensed under the MIT license found in the LICENSE file.
"""A method from outside the package in one file: it averages the labelled steps whose windows are most similar.

Nothing is trained by gradients; the closed form stores all labelled windows.
"""

import torch

from torchrl_koap.modules import InverseDynamics, WindowReader
from torchrl_koap.training import Method, register_method


class NearestNeighbours(InverseDynamics):
    """Averages the actions of the stored windows ``x_i`` with weights ``softmax(-|x - x_i|^2)``."""

    def __init__(self, state_dim, action_dim, **normalizers):
        super().__init__(WindowReader(state_dim, num_past=1, look_ahead=(1, 2, 3, 4), min_offset=1), **normalizers)
        self.register_buffer("windows", torch.zeros(0, self.reader.num_features))
        self.register_buffer("actions", torch.zeros(0, action_dim))

    def predict(self, state, frames=None):
        """Returns the normalised action of every frame."""
        features = self.reader(self.normalize_state(state), frames)
        distance = torch.cdist(features.flatten(0, -2), self.windows).square()
        return (torch.softmax(-distance, -1) @ self.actions).unflatten(0, features.shape[:-1])

    @torch.no_grad()
    def fit_labels(self, windows, mask, **_):
        """Stores the windows of the labelled frames."""
        self.windows = self.reader(self.normalize_state(windows["state"]))[mask].clone()
        self.actions = self.normalize_action(windows["action"][mask])
        return {"labels_used": int(mask.sum())}

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        for name in ("windows", "actions"):  # sizes depend on the number of stored windows
            if f"{prefix}{name}" in state_dict:
                setattr(self, name, torch.empty_like(state_dict[f"{prefix}{name}"]))
        super()._load_from_state_dict(state_dict, prefix, *rest)


def build(task, columns, normalizers, preset):
    """Builds the controller of ``--method nearest_neighbour``."""
    return NearestNeighbours(len(columns), task.action_dim, **normalizers)


register_method(Method("nearest_neighbour", "nearest labelled steps", build, closed_form=True))
