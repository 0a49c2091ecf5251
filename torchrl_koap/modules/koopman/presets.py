# This source code is licensed under the MIT license found in the LICENSE file.
"""Named variants of KOAP, each with all options from normalisation to the decoder's penalty."""

from __future__ import annotations

from typing import Any

from torch import nn

from torchrl_koap.lookup import lookup
from torchrl_koap.modules.koopman.compact_lifting import CompactLifting
from torchrl_koap.modules.koopman.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.modules.koopman.latent_action import (
    FourierKernel,
    LatentActionFourier,
    LatentActionLSTM,
    LinearActionDecoder,
)
from torchrl_koap.modules.koopman.lifting import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.koopman.smoothed_action import LatentActionSmoothed
from torchrl_koap.modules.ridge import INPUT_NOISE

_DEFAULT: dict[str, Any] = {
    "normalization": {"state": "standard", "action": "rms"},  # modes of Normalizer.fit; callers pass the normalisers
    "network": LatentActionFourier,
    "latent_dim": 32,
    "hidden_dim": 64,
    "include_state": True,
    "num_past": 4,
    "look_ahead": (2, 3, 4, 5),
    "clamped": False,
    "penalty": 0.15,
    "input_noise": INPUT_NOISE,
}

_FOURIER: dict[str, Any] = {"num_features": 512, "kernels": {"sharp": FourierKernel()}, "position_weight": 0.0}
# offered to the labels where actions are targets or raw: lower errors on Adroit's door, Unitree G1 and Stacking
_SMOOTH = {"smooth": FourierKernel(0.3, 3.0, 4.0)}

# the paper: g MLP, f LSTM, dense K, look-ahead k = 8
_PAPER: dict[str, Any] = _DEFAULT | {
    "normalization": {"state": "minmax", "action": "minmax"},
    "network": LatentActionLSTM,
    "latent_dim": 64,
    "hidden_dim": 128,
    "include_state": False,
    "num_past": 1,
    "look_ahead": 8,
    "clamped": True,
    "relative": False,
}

# all options of each variant; those that only its network takes come last
PRESETS: dict[str, dict[str, Any]] = {
    # observables of steps between frames, an input matrix B, no clamped look-ahead, a decoder in closed form
    "default": _DEFAULT | _FOURIER,
    # for robots that respond late: also reads the state 8 steps ahead, as in the paper
    "delayed": _DEFAULT | {"look_ahead": (2, 3, 4, 5, 8)} | _FOURIER | {"kernels": _FOURIER["kernels"] | _SMOOTH},
    # for actions, or commands, that are target positions: the present frame has more weight than the steps around it
    "absolute": _DEFAULT
    | {
        # Targets are far from zero compared with their spread. One state scale keeps the sizes of principal components.
        "normalization": {"state": "shared", "action": "standard"},
        "penalty": 1e-3,
    }
    | {"num_features": 1024, "kernels": {"sharp": FourierKernel(10.0, 3.0, 2.0)} | _SMOOTH, "position_weight": 1.0},
    # for noisy or high-dimensional observations: few, smoothed coordinates, fitted to unlabelled windows
    # (docs/results/unlabelled_data.md)
    "semi_supervised": _DEFAULT
    | {
        "network": LatentActionSmoothed,
        "latent_dim": None,
        "include_state": False,
        "num_past": 8,
        "look_ahead": (2, 3, 4, 5, 6, 7, 8),
    }
    | {"num_features": 512},
    # for commands of joints that are not observed: wider networks of the paper; labels also train the latent action
    "scene": _PAPER
    | {"normalization": {"state": "standard", "action": "standard"}, "hidden_dim": 256, "clamped": False},
    "paper": _PAPER,
}

# a smoothed lifting is the identity for states of at most this many columns
NARROW = 8


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

    Normalisers are those of :class:`~torchrl_koap.modules.InverseDynamics`.

    Args:
        state_dim (int): number of state columns.
        action_dim (int): size of an action.

    Keyword Args:
        preset (str): a name in :data:`PRESETS`.
        **overrides: any entry of ``PRESETS[preset]`` except ``network`` and ``normalization``.

    Returns:
        KoopmanInverseDynamics: with random weights, drawn from torch's global generator.

    Raises:
        ValueError: for an unknown preset or option; the message suggests the most similar name.

    Examples:
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> model = make_koopman_inverse_dynamics(2, 2, preset="paper")
        >>> model.latent_action.reader.look_ahead, model.latent_action.latent_dim
        ((8,), 64)
    """
    choice = {**lookup(PRESETS, preset, "preset")}
    network, _ = choice.pop("network"), choice.pop("normalization")  # the normalisers are given
    for name in overrides:
        lookup(choice, name, f"option of the inverse dynamics of preset {preset!r}:")
    choice.update(overrides)

    hidden = (choice["hidden_dim"],) * 2
    latent_dim, include_state = choice["latent_dim"], choice["include_state"]
    if latent_dim is None:  # a narrow state is kept unchanged, a wider one lifted to one coordinate per action entry
        include_state = include_state or state_dim <= NARROW
        latent_dim = state_dim if include_state else action_dim
    if "latent_dim" not in overrides and "include_state" not in overrides and latent_dim < state_dim:
        include_state = False  # the preset's size cannot contain a high-dimensional state
    own = set(choice) - set(_DEFAULT)  # options that only this network takes
    settings = {key: choice[key] for key in ("num_past", "look_ahead", "clamped", *own)}
    # the order of construction determines the initial weights of a seed
    latent_action = None
    if network is LatentActionFourier:
        latent_action = LatentActionFourier(state_dim, **settings)
    elif network is LatentActionLSTM:
        latent_action = LatentActionLSTM(state_dim, latent_dim, hidden_dim=hidden[0], **settings)
    lifting: KoopmanLifting | CompactLifting
    if network is LatentActionSmoothed and not include_state:
        widths: dict[str, Any] = {"hidden_dims": hidden} if "hidden_dim" in overrides else {}
        lifting = CompactLifting(state_dim, latent_dim, **widths)
    else:
        lifting = KoopmanLifting(state_dim, latent_dim, hidden_dims=hidden, include_state=include_state)
    latent_action = LatentActionSmoothed(lifting, **settings) if latent_action is None else latent_action
    operator = KoopmanOperator(
        lifting.latent_dim, input_dim=None if network is LatentActionLSTM else latent_action.latent_dim
    )
    return KoopmanInverseDynamics(
        latent_action,
        LinearActionDecoder(latent_action.latent_dim, action_dim),
        lifting=lifting,
        operator=operator,
        penalty=choice["penalty"],
        input_noise=choice["input_noise"],
        state_normalizer=state_normalizer,
        action_normalizer=action_normalizer,
    )
