# This source code is licensed under the MIT license found in the LICENSE file.
"""Builds planner and diffusion policy from the plain options that a run directory keeps in ``config.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import DiffusionPolicy, MLPDenoiser, StatePlanner, TemporalUnet

CLIP = 1.2  # of normalised sequences, which lie in [-1, 1] in the data


def _unet(width: int, condition_dim: int, options: Mapping[str, Any]) -> nn.Module:
    if "width" in options:
        raise ValueError("denoiser 'unet' has no width to choose, it has channels")
    return TemporalUnet(width, condition_dim, channels=tuple(options["channels"]))


def _mlp(width: int, condition_dim: int, options: Mapping[str, Any]) -> nn.Module:
    return MLPDenoiser(width, condition_dim, horizon=options["horizon"], width=options["width"])


DENOISERS = {"unet": _unet, "mlp": _mlp}
# what a denoiser is trained with where nothing else is asked for, as options of TrainConfig
SIZES = {
    "unet": {"batch_size": 128, "planner_learning_rate": 3e-3},
    "mlp": {"denoiser_width": 512, "batch_size": 512, "planner_learning_rate": 1e-3},
}


def build_planner(options: Mapping[str, Any], state_dim: int, features: nn.Module | None = None) -> StatePlanner:
    """A planner without statistics (:meth:`StatePlanner.fit_normalizers`, or weights, bring them).

    Args:
        options (mapping): the ``planner`` entry of ``config.json``: denoiser, channels or width, history, horizon,
            relative and forecast.
        state_dim (int): number of state columns.
        features (nn.Module, optional): what the condition holds besides the history, see :class:`StatePlanner`.

    Raises:
        ValueError: for an unknown denoiser, or a width that it has not.
    """
    parts = _diffusion(options, state_dim, state_dim, features)
    return StatePlanner(forecast=options.get("forecast", False), **parts)


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
        ValueError: as :func:`build_planner`.
    """
    return DiffusionPolicy(action_dim=action_dim, **_diffusion(options, state_dim, action_dim, features))


def _diffusion(options: Mapping[str, Any], state_dim: int, width: int, features: nn.Module | None) -> dict[str, Any]:
    """What planner and diffusion policy take alike, with a denoiser for sequences of that width."""
    make = lookup(DENOISERS, options["denoiser"], "denoiser")
    condition_dim = options["history"] * state_dim + (0 if features is None else features.num_features)
    return {
        "denoiser": make(width, condition_dim, options),
        "state_dim": state_dim,
        "history": options["history"],
        "horizon": options["horizon"],
        "relative": options["relative"],
        "features": features,
        "clip": CLIP,
    }
