# This source code is licensed under the MIT license found in the LICENSE file.
"""Every method that the library compares, one entry each: the network, and what it is trained on.

Fair by construction: all controllers get the same labelled windows, the same planner and the same number of updates
(two-stage methods share theirs between the stages). Networks that may look ahead read the same frames, 4 before and up
to 5 after the present one; Decision Diffuser's controller may not, it is defined by the next state. ``dp`` and
``relabel`` have no planner and make its number of updates instead, ``relabel`` those of its teacher besides.

Three controls say what the Koopman model itself is worth: ``linear``, the plain ridge on ``x_{t-1}, x_t, x_{t+8}`` with
none of KOAP's scales; ``linear_steps``, a ridge on what KOAP's latent action reads, with its scales, penalty and prior;
``koap_untrained``, KOAP with random features, of which nothing but the decoder is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.objectives import LossModule

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import (
    PRESETS,
    LinearInverseDynamics,
    NonlinearInverseDynamics,
    QuantizedInverseDynamics,
    SupervisedInverseDynamics,
    VariationalInverseDynamics,
    make_koopman_inverse_dynamics,
)
from torchrl_koap.objectives import (
    InverseDynamicsLoss,
    KOAPLoss,
    LatentDecoderLoss,
    NonlinearLoss,
    QuantizedDynamicsLoss,
    VariationalLoss,
)

LOOK_AHEAD = (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Phase:
    """A stretch of a controller's training.

    Args:
        name (str): its name in the log.
        loss (callable): the loss of a network.
        windows (str): ``"all"`` (labelled or not), ``"mixed"`` (a quarter of every batch has labels) or ``"labelled"``.
        share (float): of the updates that a controller may have.
    """

    name: str
    loss: Callable[[Any], LossModule]
    windows: str = "all"
    share: float = 1.0


@dataclass(frozen=True)
class Method:
    """A way to get from few labels to a policy.

    Args:
        title (str): what tables and legends call it.
        build (callable): makes the controller from sizes, normalisers and options; None for a policy of its own.
        phases (tuple of Phase): how the controller is trained.
        closed_form (bool): its linear decoder is fitted by ridge regression at the end.
        labelled_only (bool): it sees labelled windows and nothing else, statistics of the states included.
        acts (bool): a policy of its own, Diffusion Policy: it needs no planner and has the planner's updates instead.
        teacher (str): the method whose controller labels the rest of the data first.
        other_decoder (str): the same method with the other way to get a decoder.
        presets (tuple of str): values of ``--preset`` that it can be built with; the first is its own.
    """

    title: str
    build: Callable[..., TensorDictModuleBase] | None = None
    phases: tuple[Phase, ...] = ()
    closed_form: bool = False
    labelled_only: bool = False
    acts: bool = False
    teacher: str = ""
    other_decoder: str = ""
    presets: tuple[str, ...] = ("default",)


def _koap(state_dim, action_dim, normalizers, options, **overrides):
    return make_koopman_inverse_dynamics(state_dim, action_dim, preset=options["preset"], **normalizers, **overrides)


def _linear(state_dim, action_dim, normalizers, options):
    return LinearInverseDynamics(state_dim, action_dim)


def _supervised(state_dim, action_dim, normalizers, options, *, look_ahead):
    return SupervisedInverseDynamics(state_dim, action_dim, look_ahead=look_ahead, **normalizers)


def _network(state_dim, action_dim, normalizers, options, *, kind):
    return kind(state_dim, action_dim, **normalizers)


def without_actions(network: nn.Module) -> LossModule:
    """KOAP's loss on states alone."""
    return KOAPLoss(network, action_coeff=0.0)


_LABELS = (Phase("controller", InverseDynamicsLoss, "labelled"),)
_JOINT = (Phase("controller", KOAPLoss, "mixed"),)
# the decoder that is fitted afterwards, on a frozen encoder
_DECODER = Phase("decoder", LatentDecoderLoss, "labelled", share=0.5)

_ANY_PRESET = tuple(PRESETS)

METHODS = {
    "koap": Method(
        "KOAP",
        _koap,
        (Phase("controller", without_actions),),
        closed_form=True,
        other_decoder="koap_sgd",
        presets=_ANY_PRESET,
    ),
    "koap_sgd": Method("KOAP, decoder trained with the rest", _koap, _JOINT, other_decoder="koap", presets=_ANY_PRESET),
    "koap_paper": Method("KOAP as in the paper", _koap, _JOINT, presets=("paper",)),
    "koap_labelled_only": Method(
        "KOAP, labelled windows alone",
        _koap,
        (Phase("controller", without_actions, "labelled"),),
        closed_form=True,
        labelled_only=True,
        presets=_ANY_PRESET,
    ),
    "koap_untrained": Method("KOAP, nothing trained but the decoder", _koap, closed_form=True, presets=_ANY_PRESET),
    "pretrain": Method(
        "KOAP, pre-trained and fine-tuned",
        _koap,
        (Phase("controller", without_actions, share=0.5), Phase("finetune", KOAPLoss, "labelled", share=0.5)),
        presets=_ANY_PRESET,
    ),
    "linear_steps": Method("ridge on KOAP's scaled steps", partial(_koap, num_features=0), closed_form=True),
    "linear": Method("ridge on raw frames", _linear, closed_form=True),
    "dd": Method("supervised, next state (Decision Diffuser)", partial(_supervised, look_ahead=1), _LABELS),
    "dd_lookahead": Method("supervised, look-ahead", partial(_supervised, look_ahead=LOOK_AHEAD), _LABELS),
    "vae": Method(
        "variational autoencoder",
        partial(_network, kind=VariationalInverseDynamics),
        (Phase("controller", VariationalLoss, share=0.5), _DECODER),
    ),
    "lapo": Method(
        "LAPO, quantised latent actions",
        partial(_network, kind=QuantizedInverseDynamics),
        (Phase("controller", QuantizedDynamicsLoss, share=0.5), _DECODER),
    ),
    "nonlinear": Method(
        "KOAP with nonlinear maps",
        partial(_network, kind=NonlinearInverseDynamics),
        (Phase("controller", NonlinearLoss, "mixed"),),
    ),
    "dp": Method("Diffusion Policy", acts=True),
    "relabel": Method("Diffusion Policy on relabelled data", acts=True, teacher="dd_lookahead"),
}


def get_method(name: str, decoder: str | None = None) -> Method:
    """Looks a method up.

    Args:
        name (str): a name in :data:`METHODS`.
        decoder (str, optional): ``"ridge"`` (closed form, fitted at the end) or ``"sgd"`` (trained with the rest), for
            methods that exist with both. Default: the method's own.

    Raises:
        ValueError: if there is no such method, or not with that decoder; the message suggests the nearest name.

    Examples:
        >>> from torchrl_koap.training.methods import get_method
        >>> get_method("koap").closed_form, get_method("koap", "sgd").closed_form
        (True, False)
        >>> get_method("kaop")
        Traceback (most recent call last):
        ...
        ValueError: unknown method 'kaop'; did you mean 'koap'?
    """
    method = lookup(METHODS, name, "method")
    if decoder is None or lookup(("ridge", "sgd"), decoder, "decoder") == ("ridge" if method.closed_form else "sgd"):
        return method
    if not method.other_decoder:
        own = "a closed form" if method.closed_form else "trained by gradients"
        raise ValueError(f"the decoder of method {name!r} is {own}: it has no decoder {decoder!r}")
    return METHODS[method.other_decoder]


def normalizers_of(state: nn.Module, action: nn.Module) -> Mapping[str, nn.Module]:
    """The two normalisers as the keyword arguments that every network takes."""
    return {"state_normalizer": state, "action_normalizer": action}
