# This source code is licensed under the MIT license found in the LICENSE file.
"""The demonstrations of a curve: recorded once for all cells, thinned where less is to be used."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, flatten_trajectories, load_ted, save_ted, subsample_trajectories
from torchrl_koap.data.label_budget import Unit
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.studies.cells import Cell
from torchrl_koap.studies.curve_folder import dataset_of
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.training.datasets import load_demonstrations

if TYPE_CHECKING:
    from torchrl_koap.studies.label_efficiency import CurveConfig


def first_look(root: RunDirectory, options: CurveConfig, task: Task) -> TensorDictBase | None:
    """What can be known of the demonstrations without recording any: if nothing else, how many there will be.

    Args:
        root (RunDirectory): folder of the curve.
        options (CurveConfig): what is asked for.
        task (Task): the task.

    Returns:
        TensorDictBase or None: flat data, that of the whole where only a share is used; None if nothing is known.

    Raises:
        ValueError: for scripted demonstrations of a task without an environment.
    """
    if options.dataset == "scripted" and task.env is None:
        raise ValueError(f"task {task.name!r} has no environment to record demonstrations in: name a --dataset")
    if options.dataset != "scripted":
        return thin(load_demonstrations(dataset_of(options), task), options.data_share)
    if (root.path / "demonstrations" / "ted").exists():
        return thin(load_demonstrations(str(root.path / "demonstrations"), task), options.data_share)
    if options.units != "trajectory":
        LabelBudget(count=1, unit=cast("Unit", options.units))  # knows the units
        return None
    number = options.demonstrations or task.defaults.demonstrations
    return thin(flatten_trajectories([torch.zeros(2, 1)] * number, [torch.zeros(1, 1)] * number), options.data_share)


def demonstrations_of(root: RunDirectory, options: CurveConfig, task: Task) -> str:
    """The data set as a folder: scripted demonstrations are recorded, and a share of any chosen, once for all cells.

    Args:
        root (RunDirectory): folder of the curve.
        options (CurveConfig): what is asked for.
        task (Task): the task.
    """
    if options.dataset != "scripted":
        folder = Path(dataset_of(options))
    else:
        folder = root.path / "demonstrations"
        if not (folder / "ted").exists():
            from torchrl_koap.envs.experts.demonstrations import record_demonstrations

            episodes = options.demonstrations or task.defaults.demonstrations
            with progress_bar(episodes, "demonstrations", unit="episode") as bar:
                data, _ = record_demonstrations(task.name, episodes, 0, progress=count_up_to(bar))
            save_ted(data, folder / "ted", get_task(task.source))
    if options.data_share == 1:
        return str(folder)
    used = root.path / "demonstrations-used"
    if not (used / "ted").exists():
        if (folder / "ted").is_dir():
            whole, own = load_ted(folder / "ted")
        else:
            own = get_task(task.source)
            whole = load_demonstrations(str(folder), own).exclude("state")
        save_ted(thin(whole, options.data_share), used / "ted", own)
    return str(used)


def thin(data: TensorDictBase, share: float) -> TensorDictBase:
    """A share of the trajectories, those with a label first, renumbered; the data themselves for a share of 1.

    Args:
        data (TensorDictBase): flat data ``[N]``.
        share (float): of the trajectories, in ``(0, 1]``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories
        >>> from torchrl_koap.studies.curve_data import thin
        >>> data = flatten_trajectories([torch.zeros(5, 2)] * 8, [torch.zeros(4, 1)] * 8)
        >>> thin(data, 0.25)["episode"].unique().tolist()
        [0, 1]
    """
    if share == 1:
        return data
    lengths = torch.unique_consecutive(data["episode"], return_counts=True)[1]
    number = max(round(share * len(lengths)), 1)
    order = torch.randperm(len(lengths), generator=torch.Generator().manual_seed(0))
    labelled = torch.stack([part.any() for part in data["has_action"].split(lengths.tolist())])
    order = torch.cat([order[labelled[order]], order[~labelled[order]]])
    kept = torch.zeros(len(lengths), dtype=torch.bool)
    kept[order[:number]] = True
    chosen = data[kept.repeat_interleave(lengths)].clone()
    chosen["episode"] = torch.arange(number).repeat_interleave(lengths[kept])
    return chosen


def check_budgets(cells: Sequence[Cell], options: CurveConfig, data: TensorDictBase | None) -> None:
    """Refuses before any work what would fail in a cell: budgets that select nothing, shares below the labelled.

    Args:
        cells (sequence of Cell): the cells.
        options (CurveConfig): what is asked for.
        data (TensorDictBase, optional): flat data that are used; None: nothing is known of them.

    Raises:
        ValueError: naming the share.
    """
    if data is None:
        return
    # windows of another seed lie in another number of trajectories
    for fraction, share, seed in dict.fromkeys((cell.fraction, cell.observations, cell.seed) for cell in cells):
        amount = fraction / options.data_share
        unit = cast("Unit", options.units)  # another one is refused there
        budget = LabelBudget(fraction=amount, unit=unit, seed=seed)
        subsample_trajectories(budget.apply(data)[0], share)
