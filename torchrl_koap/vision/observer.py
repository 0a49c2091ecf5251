# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts numbers and camera frames of a robot to the observations that a policy was trained on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_koap.data.formats.frames import fault_of
from torchrl_koap.keys import observed_numbers
from torchrl_koap.tasks import Task
from torchrl_koap.vision.encoder import Projection, load_encoder

STATE = "state"


def part_widths(task: Task) -> dict[str, int]:
    """Returns the number of columns of every part of a task's observation."""
    return {name: part.stop - part.start for name, part in task.observation.items()}


class Observer:
    """Concatenates the numbers of a robot and the embeddings of its frames in the order of the task's columns.

    Args:
        task (Task): defines the observation; a part with the name of a camera holds that camera's embedding.
        cameras (mapping): projection of every camera; their networks are loaded here.

    Raises:
        ValueError: if the task has no part of a camera's name and size, or its network cannot be loaded. In use, for
            entries that are missing, unknown, of the wrong width or not frames.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap import Trained
        >>> observe = Trained.load("runs/arm").policy().observe  # doctest: +SKIP
        >>> observe({"state": np.zeros(7), "top": np.zeros((96, 96, 3), np.uint8)}).shape  # doctest: +SKIP
        torch.Size([71])
    """

    def __init__(self, task: Task, cameras: Mapping[str, Projection]):
        self.cameras = dict(cameras)
        widths = part_widths(task)
        for name, projection in cameras.items():
            if widths.get(name) != projection.dim:
                raise ValueError(
                    f"camera {name!r} has embeddings of {projection.dim} columns, task {task.name!r} has"
                    f" {widths.get(name, 'none')} for that name"
                )
        self._parts = list(widths)
        self._numbers = {name: width for name, width in widths.items() if name not in cameras}
        self._needed = [*([] if self._numbers.keys() <= {*task.hidden} else [STATE]), *cameras]
        self.state_dim = sum(self._numbers.values())  # columns that are not embeddings
        self._encoders = {name: load_encoder(projection) for name, projection in cameras.items()}

    def example(self) -> dict[str, np.ndarray]:
        """Returns zeros and black frames in the format of a robot."""
        black = {name: np.zeros((*each.size, 3), np.uint8) for name, each in self.cameras.items()}
        return {STATE: np.zeros(self.state_dim, np.float32), **black}

    def __call__(self, given: Mapping[str, Any]) -> Tensor:
        """Computes observations ``[*B, obs]``.

        Args:
            given (mapping): ``"state"``, the columns that are not embeddings ``[*B, d]``, optional if the policy reads
                none of them; and a frame of every camera under its name, uint8 ``[*B, H, W, 3]``.
        """
        wanted = [*([STATE] if self._numbers else []), *self.cameras]
        missing = [name for name in self._needed if name not in given]
        unknown = [name for name in given if name not in wanted]
        if missing or unknown:
            what = f"has no {missing[0]!r}" if missing else f"has an unknown {unknown[0]!r}"
            raise ValueError(f"the observation {what}: wanted {', '.join(wanted)}, got {', '.join(map(str, given))}")
        seen = {name: self._embedded(name, given[name]) for name in self.cameras}
        batch = next(iter(seen.values())).shape[:-1]
        state = observed_numbers(given.get(STATE, np.zeros((*batch, self.state_dim))))
        if state.shape != (*batch, self.state_dim):
            raise ValueError(f"'state' must be {[*batch, self.state_dim]} with these frames, got {list(state.shape)}")
        seen |= dict(zip(self._numbers, state.split(list(self._numbers.values()), -1), strict=True))
        dtype = torch.promote_types(state.dtype, torch.float32)
        return torch.cat([seen[name].to(dtype) for name in self._parts], -1)

    def _embedded(self, name: str, frames: Any) -> Tensor:
        """Computes the embeddings ``[*B, d]`` of one camera's frames."""
        given = frames.cpu().numpy() if isinstance(frames, Tensor) else np.asarray(frames)
        fault = fault_of(given if given.ndim < 4 else given[(0,) * (given.ndim - 3)])
        if fault is not None:
            raise ValueError(f"the frame of camera {name!r} {fault}")
        return self._encoders[name].embed(torch.from_numpy(np.ascontiguousarray(given)))
