# This source code is licensed under the MIT license found in the LICENSE file.
"""Builds networks from the options in ``config.json``; their statistics come from saved weights or from data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase
from torch import nn

from torchrl_koap.keys import ACTION, HAS_ACTION, STATE
from torchrl_koap.lookup import check_free, lookup
from torchrl_koap.modules import (
    PRESETS,
    DiffusionPolicy,
    MLPDenoiser,
    Normalizer,
    ObjectColumns,
    ObjectDenoiser,
    StatePlanner,
    TemporalUnet,
)
from torchrl_koap.modules.planning.denoisers import RelativePositionFeatures
from torchrl_koap.runs.config import ControllerConfig, PlannerConfig
from torchrl_koap.tasks import HORIZON, Task
from torchrl_koap.training.method import Method
from torchrl_koap.training.policy_facts import state_reader


def _unet(columns: int, condition_dim: int, *, width: int, frequencies: int, horizon: int) -> nn.Module:
    return TemporalUnet(columns, condition_dim, channels=(width, 2 * width), frequencies=frequencies)


# networks of planners, with their default sizes and training options
NETWORKS: dict[str, dict[str, Any]] = {
    "unet": {"build": _unet, "width": 64, "octaves": 4, "batch_size": 128, "learning_rate": 3e-3},
    "mlp": {"build": MLPDenoiser, "width": 512, "octaves": 1, "batch_size": 512, "learning_rate": 1e-3},
    "objects": {"build": ObjectDenoiser, "width": 192, "octaves": 1, "batch_size": 256, "learning_rate": 2e-3},
}


def register_network(name: str, build: Callable[..., nn.Module], **defaults: float) -> None:
    """Adds a network for planners and Diffusion Policy, which ``--planner.network`` then finds by its name.

    Args:
        name (str): its name.
        build (callable): ``build(columns, condition_dim, width=, frequencies=, horizon=)``, the denoiser of a
            :class:`~torchrl_koap.modules.planning.sampler.ConditionalSampler`: its width, the octaves of the condition
            and the frames of a sequence.
        **defaults: default ``width``, ``octaves``, ``batch_size`` and ``learning_rate``; else those of ``"mlp"``.

    Raises:
        ValueError: if there is a network of that name already, or for an unknown default.

    Examples:
        >>> from torchrl_koap.modules import MLPDenoiser
        >>> from torchrl_koap.training import register_network
        >>> register_network("mlp", MLPDenoiser)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: another network named 'mlp' is registered already; choose another name, or first ...
    """
    check_free(NETWORKS, name, "network", "torchrl_koap.training.NETWORKS")
    usual = NETWORKS["mlp"]
    for option in defaults:
        lookup(usual, option, "default of a network")
    NETWORKS[name] = {**usual, **defaults, "build": build}


def build_planner(task: Task, section: PlannerConfig) -> StatePlanner:
    """Builds a planner of states without statistics, from a section with all defaults filled in."""
    return StatePlanner(**_diffusion(task, section, plans=True))


def build_sampler(task: Task, section: PlannerConfig) -> DiffusionPolicy:
    """Builds a Diffusion Policy with the network of :func:`build_planner`, without statistics."""
    return DiffusionPolicy(action_dim=task.action_dim, **_diffusion(task, section, plans=False))


def _diffusion(task: Task, section: PlannerConfig, *, plans: bool) -> dict[str, Any]:
    """Returns the arguments that planner and Diffusion Policy share; sequences are ``plans`` or actions."""
    build = lookup(NETWORKS, section.network, "planner.network")["build"]
    pairs = task.relative_columns()
    features = RelativePositionFeatures(pairs) if pairs else None
    seen = section.frames * task.state_dim + (0 if features is None else features.num_features)
    sizes: dict[str, Any] = {"width": section.width, "frequencies": section.octaves, "horizon": HORIZON}
    if build is ObjectDenoiser:
        sizes["objects"] = _objects(task, section.frames, plans=plans)
    return {
        "denoiser": build(task.state_dim if plans else task.action_dim, seen, **sizes),
        "state_dim": task.state_dim,
        "history": section.frames,
        "horizon": HORIZON,
        "relative": task.defaults.relative,
        "features": features,
    }


def _objects(task: Task, frames: int, *, plans: bool) -> list[ObjectColumns]:
    """Returns the columns of the bodies in the state; a relative position belongs to the only body that it names."""
    own = {name: columns for name in task.objects if (columns := task.body_columns(name))}
    if not own:
        raise ValueError(f"planner.network 'objects': no body of task {task.name!r} is in the state; use 'mlp'")
    seen = {name: [frame * task.state_dim + c for frame in range(frames) for c in own[name]] for name in own}
    start = frames * task.state_dim
    for parts, pair in zip(task.relative_positions, task.relative_columns(), strict=True):
        stop = start + RelativePositionFeatures([pair]).num_features
        owners = [name for name in own if not set(parts).isdisjoint(task.body_parts(name))]
        if len(owners) == 1:
            seen[owners[0]] += range(start, stop)
        start = stop
    alike = dict.fromkeys(next((group for group in task.interchangeable if name in group), (name,)) for name in own)
    kinds = {name: kind for kind, group in enumerate(alike) for name in group}
    return [ObjectColumns(own[name] if plans else (), seen[name], kinds[name]) for name in own]


def build_controller(
    task: Task, method: Method, section: ControllerConfig, labelled: TensorDictBase | None = None
) -> nn.Module:
    """Builds a controller, with statistics of the data if these are given.

    Preset and columns of the section must be filled in. The data are flat ``[N]`` as the controller sees them, after
    the label budget was applied. State statistics come from all steps (from labelled steps for a method that sees no
    others), action statistics from labelled steps alone.
    """
    modes = lookup(PRESETS, section.preset, "preset")["normalization"]
    reader = state_reader(task, section)
    columns = (*reader.columns, *range(task.state_dim, task.state_dim + reader.width - len(reader.columns)))
    if labelled is None:
        state, action = Normalizer(len(columns)), Normalizer(task.action_dim)
    else:
        seen = labelled[HAS_ACTION] if method.sees == "labelled" else None
        state = Normalizer.fit(labelled[STATE], mode=modes["state"], mask=seen)
        action = Normalizer.fit(labelled[ACTION], mode=modes["action"], mask=labelled[HAS_ACTION])
    normalizers = {"state_normalizer": state, "action_normalizer": action}
    return method.build(task, columns, normalizers, section.preset)


def sizes_of(planner: StatePlanner) -> dict[str, Any]:
    """Returns the options that a planner was built with; a ValueError if its network is not of this library."""
    network = planner.denoiser
    if isinstance(network, TemporalUnet):
        name, width, encoder = "unet", network.down[0][0].width, network.encoder
    elif isinstance(network, MLPDenoiser):
        name, width, encoder = "mlp", network.first.out_features, network.encoder
    elif isinstance(network, ObjectDenoiser):
        name, width, encoder = "objects", network.width, network.robot_encoder
    else:
        raise ValueError(
            f"planner: its denoiser is a {type(network).__name__}: register it (register_network), and name it as"
            ' {"network": NAME} instead'
        )
    return {"network": name, "width": width, "octaves": len(encoder.frequencies), "frames": planner.history}
