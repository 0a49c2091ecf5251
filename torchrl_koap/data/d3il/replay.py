# This source code is licensed under the MIT license found in the LICENSE file.
"""D3IL's demonstrations as a TorchRL data set.

A folder of raw pickles is read once, through the restricted unpickler, into a memory-mapped data set in a cache folder;
so is a LeRobot data set.
A folder whose files have other names, sizes or times is converted again; a damaged cache is rebuilt. The raw files
are never written to.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl._utils import logger as torchrl_logger
from torchrl.data import ImmutableDatasetWriter, TensorStorage
from torchrl.data.datasets import register_dataset
from torchrl.data.datasets.common import BaseDatasetExperienceReplay

from torchrl_koap import keys
from torchrl_koap.data.d3il.conversion import find_raw_files, get_converter, read_trajectories
from torchrl_koap.data.label_budget import LabelBudget, LabelReport
from torchrl_koap.data.lerobot.files import find_lerobot_files, is_lerobot
from torchrl_koap.data.lerobot.reader import read_lerobot
from torchrl_koap.data.steps_on_disk import flatten_on_disk
from torchrl_koap.data.ted import DamagedDataError, load_ted, read_about, save_ted
from torchrl_koap.data.trajectories import select_state
from torchrl_koap.files import one_at_a_time
from torchrl_koap.tasks import Task, get_task

_CONVERSION = 2  # raise it when the same raw files convert to other data


class D3ILExperienceReplay(BaseDatasetExperienceReplay):
    """Demonstrations of a D3IL task as a replay buffer over flat steps.

    A file of ``T`` rows gives ``T - 1`` steps (docs/d3il.md, Recordings). The entries are those of
    :mod:`torchrl_koap.keys`; ``state`` holds the columns that a policy may see. Also reached by
    ``torchrl.data.datasets.load_dataset("d3il:avoiding", root=...)``.

    Args:
        task (str): name of the task. ``po_sorting`` and ``stacking_1`` use the demonstrations of ``sorting`` and
            ``stacking``.
        root (str or Path): folder of raw pickles, or a folder above it as D3IL lays them out (``<task>/data``,
            ``environments/dataset/data/<task>/data``); or a LeRobot data set (:func:`~torchrl_koap.data.read_lerobot`).
        split_file (str or Path, optional): a pickled list of the file names to use, or ``"train"`` or ``"eval"`` for
            D3IL's own (:func:`~torchrl_koap.data.find_raw_files` says where they are looked for); of a LeRobot data set
            the name of a split. Default: every demonstration, in the order of the names.
        actions (str): of a LeRobot data set: what its actions are, ``"delta"`` or ``"absolute"``.
        cache (str or Path, optional): where converted data are kept. Default: ``$KOAP_CACHE``, else
            ``~/.cache/torchrl_koap``.
        dtype (torch.dtype): floating type of the entries; the differences are taken in float64.
        label_budget (LabelBudget, optional): hides labels, and the commands that would give them away, from everything
            that uses this data set; what was spent is in :attr:`label_report`. Never part of the cache.
        progress (callable, optional): called with the number of raw files converted and that of all.
        batch_size, sampler, sample_unit, transform, prefetch, collate_fn (optional): as in
            :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        RawFolderError: with the problems of *all* files.
        ValueError: if the task is unknown, or a LeRobot data set has other columns than the task.
        FileNotFoundError: if the folder, its pickles or the split file are not there.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data import D3ILExperienceReplay, RawEpisode, write_raw_episode
        >>> positions = np.cumsum(np.full((5, 3), 0.01), axis=0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     raw = RawEpisode(robot={"des_c_pos": positions, "c_pos": positions - 0.002})
        ...     write_raw_episode(Path(folder) / "demos" / "env_000_00.pkl", raw)
        ...     dataset = D3ILExperienceReplay("avoiding", Path(folder) / "demos", cache=Path(folder) / "cache")
        ...     dataset.data["action"].shape, dataset.data["state"].shape, len(dataset)
        (torch.Size([4, 2]), torch.Size([4, 2]), 4)
    """

    label_report: LabelReport | None = None

    def __init__(
        self,
        task: str,
        root: str | Path,
        *,
        split_file: str | Path | None = None,
        actions: str = "delta",
        cache: str | Path | None = None,
        dtype: torch.dtype = torch.float32,
        label_budget: LabelBudget | None = None,
        progress: Callable[[int, int], None] | None = None,
        **kwargs: Any,
    ):
        facts = get_task(task)
        if is_lerobot(root):
            self.root, files, kind = Path(root).expanduser(), find_lerobot_files(root), [actions, split_file]
            convert = partial(_read_lerobot, self.root, facts, actions=actions, split=split_file, dtype=dtype)
        elif actions != "delta":
            raise ValueError(f"actions={actions!r} is for LeRobot data sets; {root} is none")
        else:
            (self.root, files), kind = find_raw_files(task, root, split_file=split_file), []
            convert = partial(_read_raw, self.root, facts, files, dtype=dtype, progress=progress)
        self._cache = _cache_folder(cache)
        self._data_path = self._cache / "d3il" / f"{task}-{_fingerprint(facts, files, dtype, kind)}"
        # several processes may open the same folder at the same time: one converts, the others wait for it
        with one_at_a_time(self._data_path.with_name(f".{self._data_path.name}.lock")):
            data = self._open(facts, files, convert)
        self._begin(facts, data, label_budget, kwargs)

    @classmethod
    def from_tensordict(
        cls, data: TensorDictBase, task: str, *, label_budget: LabelBudget | None = None, **kwargs: Any
    ) -> D3ILExperienceReplay:
        """Makes a data set of flat TED data in memory, for example recorded by our own environments.

        Args:
            data (TensorDictBase): flat data ``[N]`` in the storage layout.
            task (str): name of the task.
            label_budget (LabelBudget, optional): see the class.
            **kwargs: as in :class:`~torchrl.data.TensorDictReplayBuffer`.

        Raises:
            LayoutError: if the data do not follow the storage layout.
            ValueError: if the numbers of columns are not those of the task.

        Examples:
            >>> import torch
            >>> from torchrl_koap.data import D3ILExperienceReplay, flatten_trajectories
            >>> data = flatten_trajectories([torch.rand(9, 4)], [torch.rand(8, 2)])
            >>> D3ILExperienceReplay.from_tensordict(data, "avoiding", batch_size=4).sample().shape
            torch.Size([4])
        """
        self = cls.__new__(cls)
        self.root = self._cache = self._data_path = None
        self._begin(get_task(task), data, label_budget, kwargs)
        return self

    @classmethod
    def from_folder(
        cls, folder: str | Path, *, task: str | None = None, label_budget: LabelBudget | None = None, **kwargs: Any
    ) -> D3ILExperienceReplay:
        """Opens a data set that :func:`~torchrl_koap.data.save_ted` wrote.

        Args:
            folder (str or Path): the folder.
            task (str, optional): the task to use the data for: theirs, or one that takes its demonstrations, such as
                ``po_sorting`` those of ``sorting``. Default: theirs.
            label_budget (LabelBudget, optional): see the class.
            **kwargs: as in :class:`~torchrl.data.TensorDictReplayBuffer`.

        Raises:
            DamagedDataError: if files are missing or changed.
            ValueError: if the data belong to another task, or to none.
        """
        recorded = read_about(folder)["task"]
        facts = get_task(task or recorded)
        data = load_ted(folder, task=recorded if recorded == facts.name else facts.source)
        if recorded != facts.name:
            data = select_state(data, facts.state_of)
        self = cls.__new__(cls)
        self.root = self._cache = Path(folder)
        self._data_path = Path(folder)
        self._begin(facts, data, label_budget, kwargs)
        return self

    def _begin(self, task: Task, data: TensorDictBase, label_budget: LabelBudget | None, kwargs: dict) -> None:
        command = task.command_columns
        keys.validate(data, command=command)
        for key, wanted in ((keys.OBSERVATION, task.observation_dim), (keys.ACTION, task.action_dim)):
            if data.get(key).shape[-1] != wanted:
                got = data.get(key).shape[-1]
                raise ValueError(f"{key!r} of task {task.name!r} has {wanted} columns, the data have {got}")
        if keys.STATE not in data.keys():
            data = select_state(data, task.state_of)
        if label_budget is not None:
            data, self.label_report = label_budget.apply(data, command=command)
        self.task = task
        kwargs = {"writer": ImmutableDatasetWriter(), **kwargs}
        super().__init__(storage=TensorStorage(data), **kwargs)

    def _open(self, task: Task, files: Sequence[Path], convert: Callable[[Path], TensorDictBase]) -> TensorDictBase:
        if self._is_downloaded():
            try:
                return load_ted(self._data_path, task=task.name)
            except (DamagedDataError, ValueError) as error:
                torchrl_logger.warning("converting %s again: %s", self.root, error)
                shutil.rmtree(self._data_path, ignore_errors=True)
        parts = self._data_path.with_name(f".{self._data_path.name}.parts")
        shutil.rmtree(parts, ignore_errors=True)  # of a call that was killed
        try:
            notes = {"files": [file.name for file in files]}
            save_ted(convert(parts), self._data_path, task=task.name, notes=notes)
        finally:
            shutil.rmtree(parts, ignore_errors=True)
        return load_ted(self._data_path, task=task.name)

    @property
    def data(self) -> TensorDictBase:
        """All steps, flat ``[N]``, within the label budget."""
        return self._storage.get(slice(None))

    @property
    def data_path(self) -> Path | None:
        """Folder of the converted data, None for data in memory."""
        return self._data_path

    @property
    def data_path_root(self) -> Path | None:
        """Folder that holds all converted data, None for data in memory."""
        return self._cache

    def _is_downloaded(self) -> bool:
        return self._data_path is not None and self._data_path.is_dir()

    def delete(self) -> None:
        """Deletes the converted data from the cache; the raw files and recorded data sets stay.

        Raises:
            RuntimeError: if the data did not come from raw files.
        """
        if self._data_path is None or self._data_path == self.root:
            raise RuntimeError("only data converted from raw files are kept in a cache that can be deleted")
        shutil.rmtree(self._data_path)


def _read_raw(
    root: Path, task: Task, files: Sequence[Path], parts: Path, *, dtype: torch.dtype, progress: Callable | None
) -> TensorDictBase:
    trajectories = read_trajectories(get_converter(task.name), files, root, progress=progress)
    return flatten_on_disk(trajectories, parts, dtype=dtype, finish=partial(select_state, columns=task.state_of))


def _read_lerobot(root: Path, task: Task, _parts: Path, **options: Any) -> TensorDictBase:
    return select_state(read_lerobot(root, task.name, **options), task.state_of)


def _cache_folder(cache: str | Path | None) -> Path:
    return Path(cache or os.environ.get("KOAP_CACHE") or "~/.cache/torchrl_koap").expanduser()


def _fingerprint(task: Task, files: Sequence[Path], dtype: torch.dtype, kind: Sequence) -> str:
    facts = {
        "conversion": _CONVERSION,
        "task": task.name,
        "state": [task.state_columns, task.state],
        "dtype": str(dtype),
        "kind": [str(part) for part in kind],
        "files": [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files],
    }
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


register_dataset("d3il", "torchrl_koap.data:D3ILExperienceReplay", replace=True)
