# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations as a TorchRL data set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets import register_dataset
from torchrl.data.datasets.common import BaseDatasetExperienceReplay

from torchrl_koap.data.label_budget import LabelBudget, LabelReport
from torchrl_koap.data.sources import open_dataset
from torchrl_koap.tasks import get_task


class D3ILExperienceReplay(BaseDatasetExperienceReplay):
    """Demonstrations of a task as a replay buffer over flat steps.

    The entries are those of :mod:`torchrl_koap.keys`; ``state`` holds the columns that a policy may see. Also available
    as ``torchrl.data.datasets.load_dataset("d3il:avoiding", root=...)``.

    Args:
        task (str): name of the task. ``po_sorting`` and ``stacking_1`` use the demonstrations of ``sorting`` and
            ``stacking``.
        root (str or Path): folder of the demonstrations, see :func:`~torchrl_koap.data.open_dataset`.
        label_budget (LabelBudget, optional): hides labels, and commands whose changes are labels, in this data set.
            :attr:`label_report` counts the labels that are left.
        batch_size, sampler, sample_unit, transform, prefetch, collate_fn (optional): as in
            :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        FileNotFoundError: if the folder or its demonstrations are missing.
        DataError: listing the problems of all files.
        ValueError: if the task is unknown.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.data import D3ILExperienceReplay, flatten_trajectories, save_ted
        >>> from torchrl_koap.tasks import get_task
        >>> data = flatten_trajectories([torch.rand(9, 4)], [torch.rand(8, 2)])
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_ted(data, root + "/ted", get_task("avoiding"))
        ...     D3ILExperienceReplay("avoiding", folder, batch_size=4).sample()["state"].shape
        torch.Size([4, 2])
    """

    def __init__(self, task: str, root: str | Path, *, label_budget: LabelBudget | None = None, **kwargs: Any):
        self.root = Path(root).expanduser()
        data, self.task = open_dataset(root, task=get_task(task))
        self.label_report: LabelReport | None = None
        if label_budget is not None:
            data, self.label_report = label_budget.apply(data, command=self.task.command_columns)
        super().__init__(storage=TensorStorage(data), writer=ImmutableDatasetWriter(), **kwargs)

    @property
    def data(self) -> TensorDictBase:
        """All steps, flat ``[N]``, within the label budget."""
        return self._storage.get(slice(None))

    @property
    def data_path(self) -> Path:
        """Folder of the demonstrations."""
        return self.root

    data_path_root = data_path

    def _is_downloaded(self) -> bool:
        return True


register_dataset("d3il", "torchrl_koap.data:D3ILExperienceReplay", replace=True)
