# This source code is licensed under the MIT license found in the LICENSE file.
"""Builds planner and diffusion policy from the plain options that a run directory keeps in ``config.json``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from torch import nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import (
    DiffusionPolicy,
    MLPDenoiser,
    NoiseSchedule,
    StatePlanner,
    TemporalUnet,
    TransformerDenoiser,
)
from torchrl_koap.modules.diffusion.planar_frame import PlanarFrame


def _sizes(options: Mapping[str, Any], denoiser: str, *names: str) -> dict[str, Any]:
    """Those of the denoiser's own sizes that were chosen."""
    chosen = {name: options[name] for name in ("width", "depth", "frequencies", "dropout") if name in options}
    unfit = sorted(set(chosen) - set(names))
    if unfit:
        has = ", ".join(names) or "none"
        raise ValueError(f"denoiser {denoiser!r} has no {', '.join(unfit)} to choose, only {has}")
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
            horizon, relative, forecast, solver, solver_steps, clip, frame (columns of a
            :class:`~torchrl_koap.modules.diffusion.planar_frame.PlanarFrame`) and plan_steps.
        state_dim (int): number of state columns.
        features (nn.Module, optional): what the condition holds besides the history, see :class:`StatePlanner`.

    Raises:
        ValueError: for an unknown denoiser, schedule, prediction or solver.
    """
    forecast, steps = options.get("forecast", False), options.get("plan_steps")  # runs of before have none
    parts = _diffusion(options, state_dim, state_dim, features, frames=None if steps is None else len(steps))
    frame = PlanarFrame(**options["frame"]) if options.get("frame") else None
    return StatePlanner(forecast=forecast, frame=frame, steps=steps, **parts)


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


def _diffusion(
    options: Mapping[str, Any], state_dim: int, width: int, features: nn.Module | None, frames: int | None = None
) -> dict[str, Any]:
    """What planner and diffusion policy take alike, with a denoiser for sequences of that width and so many frames."""
    make = lookup(DENOISERS, options["denoiser"], "denoiser")
    features = features if options.get("relations") else None
    condition_dim = options["history"] * state_dim + (0 if features is None else features.num_features)
    return {
        "denoiser": make(width, condition_dim, dict(options) | ({} if frames is None else {"horizon": frames})),
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
