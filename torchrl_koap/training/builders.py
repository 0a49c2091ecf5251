# This source code is licensed under the MIT license found in the LICENSE file.
"""Builds data, planner and controllers from the plain options that a run directory keeps in ``config.json``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn

from torchrl_koap.data import D3ILExperienceReplay, load_ted, select_state
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import (
    DiffusionPolicy,
    MLPDenoiser,
    NoiseSchedule,
    Normalizer,
    StatePlanner,
    TemporalUnet,
    TransformerDenoiser,
)
from torchrl_koap.tasks import Task
from torchrl_koap.training.methods import Method, get_method, normalizers_of
from torchrl_koap.training.released_settings import get_released

# what every preset was designed with: how states and actions are normalised
NORMALIZATION = {
    "default": {"state": "standard", "action": "rms"},
    "paper": {"state": "minmax", "action": "minmax"},
    "released": {"state": "minmax", "action": "minmax"},
}


def load_demonstrations(
    dataset: str,
    task: Task,
    *,
    episodes: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> TensorDictBase:
    """Fully labelled demonstrations, flat, with the columns that a policy may see as ``state``.

    Args:
        dataset (str): ``"scripted"``, or a folder: of D3IL's raw pickles, a LeRobot data set, or written by
            ``koap demos``.
        task (Task): the task.
        episodes (int, optional): number of scripted demonstrations to record. Default: that of the task.
        seed (int): seed of the scripted demonstrations.
        progress (callable, optional): called with recorded and wanted scripted demonstrations.

    Raises:
        FileNotFoundError: if there is no such folder, or it holds no demonstrations.
    """
    if dataset == "scripted":
        data, _ = record_demonstrations(
            task.name, task.demonstrations if episodes is None else episodes, seed, progress=progress
        )
    elif not Path(dataset).is_dir():
        raise FileNotFoundError(f"dataset {dataset!r} is neither 'scripted' nor a folder")
    elif (Path(dataset) / "ted").is_dir():
        data = load_ted(Path(dataset) / "ted", task=task.source, memmap=False)
    else:
        data = D3ILExperienceReplay(task.name, dataset).data.clone()
    return select_state(data, task.state_of)


def _sizes(options: Mapping[str, Any], denoiser: str, *names: str) -> dict[str, Any]:
    """Those of the denoiser's own sizes that were chosen."""
    chosen = {name: options[name] for name in ("width", "depth", "frequencies", "dropout") if name in options}
    unfit = sorted(set(chosen) - set(names))
    if unfit:
        raise ValueError(
            f"denoiser {denoiser!r} has no {', '.join(unfit)} to choose, only {', '.join(names) or 'none'}"
        )
    return chosen


def _unet(width: int, condition_dim: int, options: Mapping[str, Any]) -> nn.Module:
    sizes = _sizes(options, "unet", "frequencies")
    return TemporalUnet(width, condition_dim, channels=tuple(options["channels"]), **sizes)


def _mlp(width: int, condition_dim: int, options: Mapping[str, Any], film: bool = False) -> nn.Module:
    sizes = _sizes(options, "film" if film else "mlp", "width", "depth", "frequencies", "dropout")
    return MLPDenoiser(width, condition_dim, horizon=options["horizon"], film=film, **sizes)


def _transformer(width: int, condition_dim: int, options: Mapping[str, Any]) -> nn.Module:
    return TransformerDenoiser(width, condition_dim, **_sizes(options, "transformer", "width", "depth", "frequencies"))


def _released(width: int, condition_dim: int, options: Mapping[str, Any]) -> nn.Module:
    _sizes(options, "released")
    return TemporalUnet.released(width, condition_dim)


DENOISERS = {
    "unet": _unet,
    "mlp": _mlp,
    "film": partial(_mlp, film=True),
    "transformer": _transformer,
    "released": _released,
}


def build_planner(options: Mapping[str, Any], state_dim: int, features: nn.Module | None = None) -> StatePlanner:
    """A planner without statistics (:meth:`StatePlanner.fit_normalizers`, or weights, bring them).

    Args:
        options (mapping): the ``planner`` entry of ``config.json``: denoiser, channels, schedule, prediction, history,
            horizon, relative, solver, solver_steps, clip.
        state_dim (int): number of state columns.
        features (nn.Module, optional): what the condition holds besides the history, see :class:`StatePlanner`.

    Raises:
        ValueError: for an unknown denoiser, schedule, prediction or solver.
    """
    return StatePlanner(**_diffusion(options, state_dim, state_dim, features))


def build_diffusion_policy(
    options: Mapping[str, Any], state_dim: int, action_dim: int, features: nn.Module | None = None
) -> DiffusionPolicy:
    """A diffusion policy with the denoiser of :func:`build_planner`, without statistics.

    Args:
        options (mapping): as for :func:`build_planner`.
        state_dim (int): number of state columns.
        action_dim (int): number of action columns.
        features (nn.Module, optional): what the condition holds besides the history.

    Raises:
        ValueError: for an unknown denoiser, schedule, prediction or solver.
    """
    return DiffusionPolicy(action_dim=action_dim, **_diffusion(options, state_dim, action_dim, features))


def _diffusion(options: Mapping[str, Any], state_dim: int, width: int, features: nn.Module | None) -> dict[str, Any]:
    """What planner and diffusion policy take alike, with a denoiser for sequences of that width."""
    make = lookup(DENOISERS, options["denoiser"], "denoiser")
    features = features if options.get("relations") else None
    condition_dim = options["history"] * state_dim + (0 if features is None else features.num_features)
    return {
        "denoiser": make(width, condition_dim, options),
        "schedule": NoiseSchedule(options["schedule"], options["prediction"]),
        "state_dim": state_dim,
        "history": options["history"],
        "horizon": options["horizon"],
        "relative": options["relative"],
        "features": features,
        "solver": options["solver"],
        "num_steps": options["solver_steps"],
        "clip": options["clip"],
    }


def build_controller(
    options: Mapping[str, Any], state_dim: int, action_dim: int, labelled: TensorDictBase | None = None
) -> nn.Module:
    """A controller, with statistics of the data if these are given, else without (weights bring them).

    Args:
        options (mapping): the ``controller`` entry of ``config.json``: method, decoder and preset.
        state_dim (int): number of state columns.
        action_dim (int): number of action columns.
        labelled (TensorDictBase, optional): flat data after the label budget was applied. State statistics come from
            all of it (of the labelled steps for a method that sees no others), action statistics from the labelled
            steps alone.

    Raises:
        ValueError: for an unknown method, decoder or preset.
    """
    method = method_named(options)
    modes = lookup(NORMALIZATION, options["preset"], "preset")
    if labelled is None:
        normalizers = normalizers_of(Normalizer(), Normalizer())
    else:
        seen = labelled["has_action"] if method.labelled_only else None
        normalizers = normalizers_of(
            Normalizer.fit(labelled["state"], mode=modes["state"], mask=seen),
            Normalizer.fit(labelled["action"], mode=modes["action"], mask=labelled["has_action"]),
        )
    return method.build(state_dim, action_dim, normalizers, options)


def method_named(options: Mapping[str, Any]) -> Method:
    """The method that the ``controller`` entry of ``config.json`` names.

    Raises:
        ValueError: if there is none.
    """
    if options.get("released"):
        return get_released(options["method"]).method
    return get_method(options["method"], options.get("decoder"))


def set_up_torch(threads: int, device: str) -> None:
    """Sets the number of threads and checks that the device is there.

    Raises:
        ValueError: if the number is below 1, or this machine has no such device.
    """
    if threads < 1:
        raise ValueError(f"threads must be >= 1, got {threads}")
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device must be 'cpu' or 'cuda', got {device!r}")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {device!r} was asked for, but torch finds no CUDA here (see `koap doctor`)")
    torch.set_num_threads(threads)


def make_env_of(task: Task, *, num_threads: int = 1) -> Callable[[int], Any]:
    """A function that makes an environment of the task with a given number of parallel episodes."""
    from torchrl.envs import TransformedEnv

    from torchrl_koap.envs.registry import ENVIRONMENTS  # the simulator is not needed to train from recorded data
    from torchrl_koap.envs.transforms import EndEffectorNoise

    make = lookup(ENVIRONMENTS, task.name, "task with an environment")

    def make_env(num_envs: int):
        env = make(num_envs, num_threads=num_threads, max_steps=task.max_steps)
        return TransformedEnv(env, EndEffectorNoise(task, task.noise)) if task.noise else env

    return make_env


def mode_index_of(task: Task) -> Callable[[torch.Tensor], torch.Tensor]:
    """The function that turns a task's leaf ``mode`` into a number."""
    from torchrl_koap.envs.registry import MODE_INDEX

    return lookup(MODE_INDEX, task.name, "task with an environment")
