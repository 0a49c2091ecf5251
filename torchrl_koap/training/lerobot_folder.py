# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes a policy as a folder that LeRobot's commands run, with the distribution ``lerobot_policy_koap``."""

from __future__ import annotations

import shlex
from itertools import groupby
from pathlib import Path
from typing import Any

from torchrl_koap.data.formats.lerobot import ACTION, PREFIX, STATE, SURROUNDINGS
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.training.trained import Trained
from torchrl_koap.vision import Observer

WEIGHTS = "model.safetensors"
_KIND = "koap"
_DEVICE = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
_PROCESSORS = {  # LeRobot requires these files; the policy itself converts ranges, units and frames
    "policy_preprocessor": [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        _DEVICE,
    ],
    "policy_postprocessor": [_DEVICE],
}


def number_features(trained: Trained) -> dict[str, tuple[str, ...]]:
    """Finds the columns of numbers that each LeRobot feature gives, in the policy's order.

    A column is of ``observation.environment_state`` if its name begins with ``environment_state``, else of
    ``observation.state``; :func:`~torchrl_koap.data.read_recordings` gives these names.

    Raises:
        ValueError: if the columns of a feature are not adjacent.
    """
    task, found = trained.task, dict[str, tuple[str, ...]]()
    names = [
        name
        for part, columns in task.observation.items()
        if part not in trained.cameras
        for name in task.observation_names[columns]
    ]
    for feature, group in groupby(names, _feature_of):
        columns = tuple(group)
        if feature in found:
            raise ValueError(f"columns of {feature} are not adjacent ({columns[0]}): convert the data so that they are")
        found[feature] = columns
    return found


def camera_features(trained: Trained) -> dict[str, str]:
    """Returns the LeRobot feature with the frames of each camera."""
    return {name: f"{PREFIX}image" if name == "image" else f"{PREFIX}images.{name}" for name in trained.cameras}


def write_lerobot_folder(trained: Trained, out: str | Path) -> dict[str, Any]:
    """Writes the folder: weights and task as :meth:`Trained.save`, and the descriptions that LeRobot reads.

    Returns the folder, columns and cameras by feature, and the ``lerobot-eval`` command that runs it.

    Raises:
        FileExistsError: if the folder holds another ``config.json``, such as that of the run.
        ValueError: as :func:`number_features`, or for a planner without a controller.
    """
    numbers, cameras, policy = number_features(trained), camera_features(trained), trained.policy()
    folder = RunDirectory(out)
    if (folder.path / "config.json").exists() and folder.read_json("config.json").get("type") != _KIND:
        raise FileExistsError(f"{folder.path / 'config.json'} is not LeRobot's: choose another --out")
    folder.path.mkdir(parents=True, exist_ok=True)
    inputs = {
        name: {"type": "ENV" if name == SURROUNDINGS else "STATE", "shape": [len(numbers[name])]} for name in numbers
    }
    example = Observer(trained.task, trained.cameras).example()
    for name, feature in cameras.items():
        height, width, colours = example[name].shape
        inputs[feature] = {"type": "VISUAL", "shape": [colours, height, width]}
    outputs = {ACTION: {"type": "ACTION", "shape": [trained.task.action_dim]}}
    config = {"type": _KIND, "n_obs_steps": policy.history, "input_features": inputs, "output_features": outputs}
    trained.save(folder.path / WEIGHTS)
    folder.write_json("config.json", config | {"device": "cpu"})
    for name, steps in _PROCESSORS.items():
        folder.write_json(f"{name}.json", {"name": name, "steps": steps})
    return {
        "folder": str(folder.path),
        **{name: ", ".join(columns) for name, columns in numbers.items()},
        **{feature: "x".join(map(str, inputs[feature]["shape"])) for feature in cameras.values()},
        ACTION: ", ".join(trained.task.action_names),
        "next": f"lerobot-eval --policy.path={shlex.quote(str(folder.path))} --env.type=... (or lerobot-record)",
    }


def _feature_of(column: str) -> str:
    return SURROUNDINGS if column.startswith(SURROUNDINGS.removeprefix(PREFIX)) else STATE
