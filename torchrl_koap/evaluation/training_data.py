# This source code is licensed under the MIT license found in the LICENSE file.
"""The demonstrations that a run was trained on, and the labels that its budget let it see."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tensordict import TensorDictBase

from torchrl_koap.data import LabelReport
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.training.datasets import load_demonstrations

if TYPE_CHECKING:
    from torchrl_koap.evaluation.trained_run import TrainedRun


def load_training_data(trained: TrainedRun, dataset: str | None = None) -> TensorDictBase:
    """The demonstrations that a run was trained on, with all labels that there are.

    Args:
        trained (TrainedRun): the run.
        dataset (str, optional): where they are now. Default: where they were.

    Raises:
        RunDirectoryError: if they are not there.
    """
    where = dataset or trained.config["dataset"]
    if where != "scripted" and not Path(where).is_dir():
        raise RunDirectoryError(
            f"the data set {where!r} of {trained.directory.path} is not there (moved, or named relative to another"
            " working directory?): say where it is with --dataset"
        )
    return load_demonstrations(where, trained.task, episodes=trained.config.get("episodes"))


def hide_labels_again(
    trained: TrainedRun, data: TensorDictBase, dataset: str | None = None
) -> tuple[TensorDictBase, LabelReport]:
    """The same demonstrations with the labels of the training alone: actions of all others are NaN.

    Args:
        trained (TrainedRun): the run.
        data (TensorDictBase): what :func:`load_training_data` returned.
        dataset (str, optional): where that was, for the message.

    Returns:
        tuple: the data, and what the budget took.

    Raises:
        RunDirectoryError: if they are not the demonstrations that the run was trained on.
    """
    hidden, report = trained.budget.apply(data, command=trained.task.command_columns)
    recorded = trained.directory.read_entry("summary.json", "labels")  # runs of older versions name fewer facts
    if {name: report.as_dict().get(name) for name in recorded} != recorded:
        raise RunDirectoryError(
            f"the data set {dataset or trained.config['dataset']!r} is not the one that {trained.directory.path} was"
            " trained on: its trajectories or labels differ"
        )
    return hidden, report
