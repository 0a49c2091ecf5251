# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap doctor`` and ``koap validate``: what this machine offers, and whether data are sound."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
from dataclasses import dataclass

import torch
import tyro

from torchrl_koap.commands.command import Command
from torchrl_koap.keys import validate
from torchrl_koap.tasks import get_task
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.plugins import Plugins, load_plugins


@dataclass(kw_only=True)
class Doctor(Command):
    """Print versions, processors, graphics and optional packages: the first thing to attach to a question."""

    def __call__(self) -> dict[str, str]:
        """Facts about this machine, name to value."""
        return machine_facts()


@dataclass(kw_only=True)
class Validate(Command):
    """Check a folder of demonstrations and report every problem found.

    Attributes:
        dataset: folder of D3IL raw pickles, a LeRobot data set, or a folder written by `koap demos`.
        task: name of the task.
        plugins: modules that register tasks; imported before anything else.
    """

    dataset: tyro.conf.Positional[str]
    task: str = "avoiding"
    plugins: Plugins = ()

    def __call__(self) -> dict[str, str]:
        """Reads and checks demonstrations.

        Raises:
            LayoutError, RawFolderError: with all problems.
        """
        load_plugins(self.plugins)
        task = get_task(self.task)
        data = validate(load_demonstrations(self.dataset, task))
        lengths = data["episode"].unique(return_counts=True)[1]
        return {
            "trajectories": str(len(lengths)),
            "steps": str(len(data)),
            "shortest, longest": f"{int(lengths.min())}, {int(lengths.max())}",
            "observation, action columns": f"{data['observation'].shape[-1]}, {data['action'].shape[-1]}",
            "verdict": "no problem found",
        }


def machine_facts() -> dict[str, str]:
    """Facts about this machine, name to value."""
    facts = {"python": platform.python_version(), "platform": platform.platform()}
    for name in (
        "torchrl_koap",
        "torch",
        "torchrl",
        "tensordict",
        "mujoco",
        "dm-control",
        "gymnasium-robotics",
        "numba",
    ):
        try:
            facts[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            facts[name] = "MISSING"
    facts["processors"] = str(os.cpu_count())
    facts["torch threads"] = str(torch.get_num_threads())
    facts["CUDA"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    facts["rendering (3-D pictures)"] = _rendering()
    for extra, module in {"wandb": "wandb", "video": "imageio", "lerobot": "pyarrow"}.items():
        found = importlib.util.find_spec(module) is not None
        facts[f"extra {extra}"] = "installed" if found else f"not installed (pip install 'torchrl_koap[{extra}]')"
    return facts


def _rendering() -> str:
    from torchrl_koap.envs.mujoco.rendering import backends

    usable = backends()
    return ", ".join(usable) if usable else "no OpenGL library (apt install libegl1, then MUJOCO_GL=egl)"
