# This source code is licensed under the MIT license found in the LICENSE file.
"""Named combinations of lifting, operator, latent-action network and decoder: one line of keywords per choice."""

from __future__ import annotations

from typing import Any

from torch import nn

from torchrl_koap.keys import STATE
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.koopman.action_decoder import LinearActionDecoder
from torchrl_koap.modules.koopman.compact_lifting import CompactLifting
from torchrl_koap.modules.koopman.inverse_dynamics import NORMALIZED_STATE, KoopmanInverseDynamics
from torchrl_koap.modules.koopman.latent_action import LatentActionFourier, LatentActionLSTM, LatentActionMLP
from torchrl_koap.modules.koopman.lifting import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.koopman.smoothed_action import LatentActionSmoothed

PRESETS: dict[str, dict[str, Any]] = {
    # best measured (docs/results/avoiding.md): observables of the frames relative to the current one, an input matrix
    # B, no clamped look-ahead, a decoder in closed form
    "default": {
        "latent_dim": 32,
        "hidden_dim": 64,
        "recurrent_lifting": False,
        "include_state": True,
        "structure": "dense",
        "operator_init": "identity",
        "network": "fourier",
        "num_features": 512,
        "num_past": 4,
        "look_ahead": (2, 3, 4, 5),
        "clamped": False,
    },
    # where observations are noisy or wide: few coordinates that unlabelled windows determine, smoothed
    # (docs/results/unlabelled_data.md)
    "semi_supervised": {
        "latent_dim": None,
        "hidden_dim": 64,
        "recurrent_lifting": False,
        "include_state": False,
        "structure": "dense",
        "operator_init": "identity",
        "lifting": "compact",
        "network": "smoothed",
        "num_features": 512,
        "num_past": 8,
        "look_ahead": (2, 3, 4, 5, 6, 7, 8),
        "clamped": False,
    },
    # the paper: g MLP, f LSTM, dense K, look-ahead k = 8
    "paper": {
        "latent_dim": 64,
        "hidden_dim": 128,
        "recurrent_lifting": False,
        "include_state": False,
        "structure": "dense",
        "operator_init": "identity",
        "network": "lstm",
        "num_past": 1,
        "look_ahead": 8,
        "relative": False,
        "clamped": True,
        "linear_skip": False,
        "dropout": 0.0,
    },
    # KOAP's first public code: recurrent g, feed-forward f on raw states, diagonal K, k = 7 steps ahead in effect
    "released": {
        "latent_dim": 512,
        "hidden_dim": 256,
        "recurrent_lifting": True,
        "include_state": False,
        "structure": "diagonal",
        "operator_init": "normal",
        "network": "mlp",
        "num_past": 1,
        "look_ahead": 7,
        "relative": False,
        "clamped": True,
        "linear_skip": False,
        "dropout": 0.1,
    },
}

LIFTINGS = ("single", "compact")

# a smoothed lifting keeps states of at most so many columns as they are
NARROW = 8

# what only one kind of latent-action network takes, and its value where a preset does not name it
NETWORK_OPTIONS: dict[str, dict[str, Any]] = {
    "fourier": {"num_features": 256, "curvature": 0.1, "motion_scale": 1.0, "position_scale": 4.0, "place": 0.0},
    "lstm": {"relative": False},
    "smoothed": {
        **{"num_features": 256, "curvature": 0.1, "motion_scale": 1.0, "position_scale": 4.0},
        "lifting": "single",  # or "compact": CompactLifting, where the lifting is learned
    },
    "mlp": {"relative": False, "linear_skip": False, "dropout": 0.0},
}


def make_koopman_inverse_dynamics(
    state_dim: int,
    action_dim: int,
    *,
    preset: str = "default",
    state_normalizer: nn.Module | None = None,
    action_normalizer: nn.Module | None = None,
    **overrides,
) -> KoopmanInverseDynamics:
    """Builds a :class:`KoopmanInverseDynamics` from a preset; keywords override single choices.

    Args:
        state_dim (int): size of a state.
        action_dim (int): size of an action.

    Keyword Args:
        preset (str): ``"default"``, ``"semi_supervised"``, ``"paper"`` or ``"released"``.
        state_normalizer (nn.Module, optional): see :class:`KoopmanInverseDynamics`.
        action_normalizer (nn.Module, optional): see :class:`KoopmanInverseDynamics`.
        **overrides: any entry of ``PRESETS[preset]``, and of ``NETWORK_OPTIONS`` for the network chosen.

    Returns:
        KoopmanInverseDynamics: with fresh weights, drawn from torch's global generator.

    Raises:
        ValueError: for an unknown preset or option; the message suggests the nearest.

    Examples:
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> model = make_koopman_inverse_dynamics(2, 2, preset="released")
        >>> sum(p.numel() for p in model.parameters())
        1387524
    """
    choice = lookup(PRESETS, preset, "preset")
    network = overrides.get("network", choice["network"])
    options = lookup(NETWORK_OPTIONS, network, "network")
    foreign = {name for others in NETWORK_OPTIONS.values() for name in others} - set(options)
    choice = {**options, **{name: value for name, value in choice.items() if name not in foreign}}
    for name in overrides:
        lookup(choice, name, f"option of the inverse dynamics with network {network!r}:")
    choice.update(overrides)

    hidden, skip = choice["hidden_dim"], network == "smoothed"
    latent_dim, include_state = choice["latent_dim"], choice["include_state"]
    if latent_dim is None:  # the state as it is where it is narrow, else a coordinate per action
        include_state = include_state or state_dim <= NARROW
        latent_dim = state_dim if include_state else action_dim
    if "latent_dim" not in overrides and "include_state" not in overrides and latent_dim < state_dim:
        include_state = False  # a preset's size is too small for a wide state to be part of the lifting
    frames = {key: choice[key] for key in ("num_past", "look_ahead", "clamped", *options) if key != "lifting"}
    # networks are built in this order: their first weights are drawn one after the other
    latent_action = None
    if network == "fourier":
        latent_action = LatentActionFourier(state_dim, **frames)
    elif network == "lstm":
        latent_action = LatentActionLSTM(state_dim, latent_dim, hidden_dim=hidden, **frames)
    elif network == "mlp":
        latent_action = LatentActionMLP(state_dim, latent_dim, hidden_dims=(hidden, hidden), **frames)
    in_key = NORMALIZED_STATE if state_normalizer is not None else STATE
    if lookup(LIFTINGS, choice.get("lifting", "single"), "lifting") == "compact" and not include_state:
        widths: dict[str, Any] = {"hidden_dims": (hidden, hidden)} if "hidden_dim" in overrides else {}
        lifting = CompactLifting(state_dim, latent_dim, in_key=in_key, **widths)
    else:
        lifting = KoopmanLifting(
            state_dim,
            latent_dim,
            hidden_dims=(hidden, hidden),
            include_state=include_state,
            recurrent=choice["recurrent_lifting"],
            linear_skip=skip and not include_state and not choice["recurrent_lifting"],
            in_key=in_key,
        )
    latent_action = LatentActionSmoothed(lifting, **frames) if latent_action is None else latent_action
    operator = KoopmanOperator(
        lifting.latent_dim,
        input_dim=latent_action.latent_dim if network in ("fourier", "smoothed") else None,
        structure=choice["structure"],
        init=choice["operator_init"],
    )
    decoder = LinearActionDecoder(latent_action.latent_dim, action_dim)
    return KoopmanInverseDynamics(
        latent_action,
        decoder,
        lifting=lifting,
        operator=operator,
        state_normalizer=state_normalizer,
        action_normalizer=action_normalizer,
    )
