# This source code is licensed under the MIT license found in the LICENSE file.
"""Named combinations of lifting, operator, latent-action network and decoder: one line of keywords per choice."""

from __future__ import annotations

import difflib

from torch import nn

from torchrl_koap.modules.action_decoder import LinearActionDecoder
from torchrl_koap.modules.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.modules.koopman import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.latent_action import LatentActionFourier, LatentActionLSTM, LatentActionMLP

PRESETS = {
    # best measured (benchmarks/RESULTS.md): observables of the frames relative to the current one, an input matrix
    # B, no clamped look-ahead, a decoder in closed form
    "default": {
        "latent_dim": 64,
        "hidden_dim": 128,
        "recurrent_lifting": False,
        "include_state": True,
        "structure": "dense",
        "operator_init": "identity",
        "network": "fourier",
        "num_features": 256,
        "history": 4,
        "look_ahead": (2, 3, 4, 6, 8),
        "clamped": False,
    },
    # design section 2: g MLP, f LSTM, dense K, look-ahead k = 8
    "paper": {
        "latent_dim": 64,
        "hidden_dim": 128,
        "recurrent_lifting": False,
        "include_state": False,
        "structure": "dense",
        "operator_init": "identity",
        "network": "lstm",
        "history": 1,
        "look_ahead": 8,
        "relative": False,
        "clamped": True,
        "linear_skip": False,
        "dropout": 0.0,
    },
    # koap_release_notes section 3.1: recurrent g, feed-forward f on raw states, diagonal K, k = 7 steps ahead in effect
    "released": {
        "latent_dim": 512,
        "hidden_dim": 256,
        "recurrent_lifting": True,
        "include_state": False,
        "structure": "diagonal",
        "operator_init": "normal",
        "network": "mlp",
        "history": 1,
        "look_ahead": 7,
        "relative": False,
        "clamped": True,
        "linear_skip": False,
        "dropout": 0.1,
    },
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
        preset (str): ``"default"``, ``"paper"`` or ``"released"``.
        state_normalizer (nn.Module, optional): see :class:`KoopmanInverseDynamics`.
        action_normalizer (nn.Module, optional): see :class:`KoopmanInverseDynamics`.
        **overrides: any entry of ``PRESETS[preset]``.

    Raises:
        ValueError: for an unknown preset or option; the message suggests the nearest.

    Examples:
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> model = make_koopman_inverse_dynamics(2, 2, preset="released")
        >>> sum(p.numel() for p in model.parameters())
        1387524
    """
    choice = dict(_lookup(PRESETS, preset, "preset"))
    for name in overrides:
        _lookup(choice, name, "option of the inverse dynamics")
    choice.update(overrides)

    latent_dim, hidden = choice["latent_dim"], choice["hidden_dim"]
    normalized_state = "normalized_state" if state_normalizer is not None else "state"
    frames = {key: choice[key] for key in ("history", "look_ahead", "clamped")} | {"in_key": normalized_state}
    if choice["network"] == "fourier":
        latent_action = LatentActionFourier(state_dim, choice["num_features"], **frames)
    elif choice["network"] == "lstm":
        latent_action = LatentActionLSTM(
            state_dim, latent_dim, hidden_dim=hidden, relative=choice["relative"], **frames
        )
    else:
        extra = {key: choice[key] for key in ("relative", "linear_skip", "dropout")}
        latent_action = LatentActionMLP(state_dim, latent_dim, hidden_dims=(hidden, hidden), **extra, **frames)
    lifting = KoopmanLifting(
        state_dim,
        latent_dim,
        hidden_dims=(hidden, hidden),
        include_state=choice["include_state"],
        recurrent=choice["recurrent_lifting"],
        in_key=normalized_state,
    )
    operator = KoopmanOperator(
        latent_dim,
        input_dim=latent_action.latent_dim if choice["network"] == "fourier" else None,
        structure=choice["structure"],
        init=choice["operator_init"],
    )
    decoder = LinearActionDecoder(
        latent_action.latent_dim, action_dim, out_key="normalized_action" if action_normalizer is not None else "action"
    )
    return KoopmanInverseDynamics(
        latent_action,
        decoder,
        lifting=lifting,
        operator=operator,
        state_normalizer=state_normalizer,
        action_normalizer=action_normalizer,
    )


def _lookup(table: dict, name: str, what: str):
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(table)}"
        raise ValueError(f"unknown {what} {name!r}; {hint}")
    return table[name]
