# This source code is licensed under the MIT license found in the LICENSE file.
"""A data set of this library as recordings, so that it can be written in another format."""

from __future__ import annotations

import numpy as np
import torch

from torchrl_koap import keys
from torchrl_koap.data.formats.recordings import Recordings, make_recordings
from torchrl_koap.data.ted import load_ted, stored_folder
from torchrl_koap.data.trajectories import trajectory_lengths


def is_stored(source: str) -> bool:
    """Whether a folder holds a data set of this library."""
    return stored_folder(source) is not None


def read_stored(source: str) -> Recordings:
    """Reads all observation columns of a data set, the command included, and the labels that there are."""
    data, task = load_ted(stored_folder(source) or source)
    lengths = trajectory_lengths(data).tolist()
    observed, behind = data[keys.OBSERVATION].double(), data[keys.NEXT_OBSERVATION].double()
    actions = torch.where(data[keys.HAS_ACTION], data[keys.ACTION].double(), torch.nan)
    pairs = zip(observed.split(lengths), behind.split(lengths), strict=True)
    return make_recordings(
        [torch.cat([frames, following[-1:]]) for frames, following in pairs],
        actions.split(lengths),
        state_names=task.observation_names,
        action_names=task.action_names,
        sources=np.arange(len(lengths)).astype(str),
        control_hz=task.control_hz,
        source=source,
    )
