# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings of any robot as a TorchRL data set: ``torchrl.data.datasets.load_dataset("koap:PLACE")``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl.data.datasets import register_dataset

from torchrl_koap.data.d3il.replay import D3ILExperienceReplay
from torchrl_koap.data.demonstrations import make_demonstrations
from torchrl_koap.data.label_budget import LabelBudget
from torchrl_koap.data.sources import read_recordings
from torchrl_koap.data.ted import load_ted, read_about, read_task
from torchrl_koap.tasks import get_task


class RecordedExperienceReplay(D3ILExperienceReplay):
    """Recordings in any format that there is a reader for, as a replay buffer over flat steps.

    The entries are those of :mod:`torchrl_koap.keys`; :attr:`task` is made from the recordings, or is theirs. A data
    set of this library is memory-mapped, everything else is read into memory.

    Args:
        source (str or Path): a data set of this library, a folder of ``*.npz``, ``*.csv`` or ``*.parquet`` files, a
            LeRobot data set, an HDF5 file in robomimic's layout, or ``minari:NAME``.
        control_hz (float, optional): frames per second. Default: as the source says.
        observations (sequence of str): as in :func:`~torchrl_koap.data.read_recordings`.
        action_columns (sequence of str): likewise.
        action_dim (int, optional): likewise.
        description (dict, optional): what :func:`~torchrl_koap.data.make_demonstrations` takes besides: ``name``,
            ``robot``, ``command``, ``action_kind``, units.
        label_budget (LabelBudget, optional): hides labels from everything that uses this data set; what was spent is in
            ``label_report``.
        batch_size, sampler, sample_unit, transform, prefetch, collate_fn (optional): as in
            :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        RecordingsError: with all faults of the recordings, or of their description.
        DamagedDataError: if files of a data set of this library are missing or changed.
        ValueError: if a data set of this library, which holds its description, is given another one.
        FileNotFoundError: if there is no such source.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl.data.datasets import load_dataset
        >>> import torchrl_koap.data
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(Path(folder) / "run.npz", states=np.random.rand(9, 3), actions=np.random.rand(8, 2))
        ...     dataset = load_dataset(f"koap:{folder}", control_hz=30, batch_size=4)
        ...     dataset.sample()["action"].shape, dataset.task.observation_dim
        (torch.Size([4, 2]), 3)
    """

    def __init__(
        self,
        source: str | Path,
        *,
        control_hz: float | None = None,
        observations: Sequence[str] = (),
        action_columns: Sequence[str] = (),
        action_dim: int | None = None,
        description: dict[str, Any] | None = None,
        label_budget: LabelBudget | None = None,
        **kwargs: Any,
    ):
        self.root = self._cache = self._data_path = None
        places = [Path(source), Path(source) / "ted"]
        folder = next((place for place in places if (place / "about.json").is_file()), None)
        reading = {"control_hz": control_hz, "observations": observations, "action_columns": action_columns}
        reading |= {"action_dim": action_dim, "description": description}
        if folder is None:
            described = reading.pop("description") or {}
            data, task = make_demonstrations(read_recordings(source, **reading), **described)
        else:
            given = [name for name, value in reading.items() if value]
            if given:
                raise ValueError(f"{folder} holds its description; {', '.join(given)} cannot be given as well")
            task = read_task(folder) or get_task(read_about(folder)["task"])
            data = load_ted(folder, task=task.name)
            self.root = self._cache = self._data_path = folder
        self._begin(task, data, label_budget, kwargs)


register_dataset("koap", "torchrl_koap.data:RecordedExperienceReplay", replace=True)
