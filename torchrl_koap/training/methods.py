# This source code is licensed under the MIT license found in the LICENSE file.
"""Every method that the library compares, one entry each: the network, and what it is trained on.

A method from outside the package is registered the same way (:func:`register_method`) by a module that ``--plugin`` or
an entry point of the group ``torchrl_koap.methods`` names.

Fair by construction: all controllers get the same labelled windows, the same planner and the same number of updates
(two-stage methods share theirs between the stages). Networks that may look ahead read the same frames, 4 before and up
to 5 after the present one, but for two that are defined otherwise: Decision Diffuser's controller (``dd``, and
``relabel``, which is one trained on a teacher's actions) is told the next state, ``vae`` encodes the whole window.
``dp`` and ``dp_relabel`` have no planner and make its number of updates instead; relabelling costs the updates of the
teacher besides.

Two controllers are no inverse dynamics and have nothing of KOAP: ``mpc`` follows plans by an identified model of how
the robot answers commands, ``command_regression`` by the commands that belong to states.

Four controls say what the Koopman model itself is worth: ``linear``, the plain ridge on ``x_{t-1}, x_t, x_{t+8}`` with
none of KOAP's scales; ``linear_steps``, a ridge on what KOAP's latent action reads, with its scales, penalty and prior;
``koap_untrained``, KOAP with random features, of which nothing but the decoder is fitted;
``pca``, a ridge on principal components of all windows, labelled or not.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import nn
from torchrl.objectives import LossModule

from torchrl_koap.lookup import lookup
from torchrl_koap.modules import (
    PRESETS,
    LinearInverseDynamics,
    NonlinearInverseDynamics,
    PrincipalInverseDynamics,
    QuantizedInverseDynamics,
    ResponseModel,
    SupervisedInverseDynamics,
    VariationalInverseDynamics,
    make_koopman_inverse_dynamics,
)
from torchrl_koap.objectives import (
    ActionLoss,
    DiffusionPolicyLoss,
    KOAPLoss,
    QuantizedDynamicsLoss,
    VariationalLoss,
)
from torchrl_koap.runs.plugins import load_entry_points
from torchrl_koap.training.command_model import SHARE, UPDATES, build_decoder, decoder_columns, fit_decoder
from torchrl_koap.training.diffusion_builders import build_diffusion_policy
from torchrl_koap.training.method import Method, Phase
from torchrl_koap.training.response import fit_response, tracked_columns

LOOK_AHEAD = (1, 2, 3, 4, 5)
GROUP = "torchrl_koap.methods"  # of entry points


def _koap(state_dim, action_dim, normalizers, options, **overrides):
    return make_koopman_inverse_dynamics(state_dim, action_dim, preset=options["preset"], **normalizers, **overrides)


def _response(state_dim, action_dim, normalizers, options):
    return ResponseModel(**options["columns"], action_dim=action_dim)


def _fit_response(response, data, updates):
    return fit_response(response, data)


def _command_decoder(state_dim, action_dim, normalizers, options):
    return build_decoder(options["columns"], action_dim)


def _fit_command_decoder(decoder, data, updates):
    return fit_decoder(decoder, data, updates=min(max(SHARE * updates, 1), UPDATES))


def _linear(state_dim, action_dim, normalizers, options):
    return LinearInverseDynamics(state_dim, action_dim)


def _supervised(state_dim, action_dim, normalizers, options, *, look_ahead):
    return SupervisedInverseDynamics(state_dim, action_dim, look_ahead=look_ahead, **normalizers)


def _network(state_dim, action_dim, normalizers, options, *, kind):
    return kind(state_dim, action_dim, **normalizers)


def _diffusion_policy(state_dim, action_dim, features, options):
    return build_diffusion_policy(options, state_dim, action_dim, features)


def without_actions(network: nn.Module, *, koopman_coeff: float = 1.0) -> LossModule:
    """KOAP's loss on states alone.

    Args:
        network (nn.Module): the model.

    Keyword Args:
        koopman_coeff (float): weight of its Koopman term. Defaults to ``1``.
    """
    return KOAPLoss(network, action_coeff=0.0, koopman_coeff=koopman_coeff)


_BOTH = ("koopman_coeff", "action_coeff")
_UNLABELLED = Phase("controller", without_actions, coefficients=("koopman_coeff",))
_LABELS = (Phase("controller", ActionLoss, "labelled"),)
_JOINT = (Phase("controller", KOAPLoss, "mixed", coefficients=_BOTH),)
# the decoder that is fitted afterwards, on a frozen encoder
_DECODER = Phase("decoder", partial(ActionLoss, freeze_latents=True), "labelled", share=0.5)


_POLICY = (Phase("policy", DiffusionPolicyLoss, "labelled"),)

_ANY_PRESET = tuple(PRESETS)
_EVERY_STEP = {"strategy": "feedback", "gain": 1.0}  # they know the command that they gave, and how it is answered

METHODS: dict[str, Method] = {}


def register_method(method: Method) -> Method:
    """Adds a method, which ``koap train --method``, curves and reports then know by its name.

    Args:
        method (Method): the method.

    Returns:
        Method: the same.

    Raises:
        ValueError: if there is a method of that name already, or the methods that it names are unknown.

    Examples:
        >>> from torchrl_koap.training.methods import METHODS, register_method
        >>> register_method(METHODS["koap"])
        Traceback (most recent call last):
        ...
        ValueError: there is a method 'koap' already ('KOAP'); choose another name
    """
    if method.name in METHODS:
        raise ValueError(
            f"there is a method {method.name!r} already ({METHODS[method.name].title!r}); choose another name"
        )
    if method.teacher and not lookup(METHODS, method.teacher, "teacher").has_planner:
        raise ValueError(f"the teacher of method {method.name!r} must be a controller, {method.teacher!r} is a policy")
    METHODS[method.name] = method
    return method


for _method in (
    Method(
        "koap",
        "KOAP",
        _koap,
        (_UNLABELLED,),
        closed_form=True,
        other_decoder="koap_sgd",
        presets=_ANY_PRESET,
    ),
    Method(
        "mpc",
        "MPC with an identified response",
        _response,
        columns=tracked_columns,
        fit=_fit_response,
        execution=_EVERY_STEP,
    ),
    Method(
        "command_regression",
        "regression of the command on the state",
        _command_decoder,
        columns=decoder_columns,
        fit=_fit_command_decoder,
        knows_commands=True,
        execution=_EVERY_STEP,
    ),
    Method("koap_sgd", "KOAP, decoder trained with the rest", _koap, _JOINT, other_decoder="koap", presets=_ANY_PRESET),
    Method(
        "koap_paper",
        "KOAP as in the paper",
        _koap,
        _JOINT,
        presets=("paper",),
        execution={"strategy": "open_loop", "blend": 0.0, "candidates": 1},
    ),
    Method(
        "koap_labelled_only",
        "KOAP, labelled windows alone",
        _koap,
        (replace(_UNLABELLED, windows="labelled"),),
        closed_form=True,
        labelled_only=True,
        presets=_ANY_PRESET,
    ),
    Method("koap_untrained", "KOAP, nothing trained but the decoder", _koap, closed_form=True, presets=_ANY_PRESET),
    Method(
        "pretrain",
        "KOAP, pre-trained and fine-tuned",
        _koap,
        (
            replace(_UNLABELLED, share=0.5),
            Phase("finetune", KOAPLoss, "labelled", share=0.5, coefficients=_BOTH),
        ),
        presets=_ANY_PRESET,
    ),
    Method("linear_steps", "ridge on KOAP's scaled steps", partial(_koap, num_features=0), closed_form=True),
    Method(
        "pca",
        "ridge on principal components of unlabelled windows",
        partial(_network, kind=PrincipalInverseDynamics),
        closed_form=True,
    ),
    Method("linear", "ridge on raw frames", _linear, closed_form=True),
    Method("dd", "supervised, next state (Decision Diffuser)", partial(_supervised, look_ahead=1), _LABELS),
    Method("dd_lookahead", "supervised, look-ahead", partial(_supervised, look_ahead=LOOK_AHEAD), _LABELS),
    Method(
        "vae",
        "variational autoencoder of whole windows",
        partial(_network, kind=VariationalInverseDynamics),
        (
            Phase("controller", VariationalLoss, share=0.5),
            replace(_DECODER, loss=partial(ActionLoss, freeze_latents=True, sample=True)),
        ),
    ),
    Method(
        "lapo",
        "LAPO, quantised latent actions",
        partial(_network, kind=QuantizedInverseDynamics),
        (Phase("controller", QuantizedDynamicsLoss, share=0.5), _DECODER),
    ),
    Method(
        "nonlinear",
        "KOAP with nonlinear maps",
        partial(_network, kind=NonlinearInverseDynamics),
        _JOINT,
    ),
    Method("dp", "Diffusion Policy", _diffusion_policy, _POLICY, kind="policy"),
    Method(
        "relabel",
        "Decision Diffuser on relabelled data",
        partial(_supervised, look_ahead=1),
        _LABELS,
        teacher="dd_lookahead",
    ),
    Method(
        "dp_relabel",
        "Diffusion Policy on relabelled data",
        _diffusion_policy,
        _POLICY,
        kind="policy",
        teacher="dd_lookahead",
    ),
):
    register_method(_method)


def get_method(name: str, decoder: str | None = None) -> Method:
    """Looks a method up.

    Args:
        name (str): a name in :data:`METHODS`.
        decoder (str, optional): ``"ridge"`` (closed form, fitted at the end) or ``"sgd"`` (trained with the rest), for
            methods that exist with both. Default: the method's own.

    Returns:
        Method: the entry of :data:`METHODS`.

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
    if name not in METHODS:
        load_entry_points(GROUP)
    method = lookup(METHODS, name, "method")
    if decoder is None or lookup(("ridge", "sgd"), decoder, "decoder") == ("ridge" if method.closed_form else "sgd"):
        return method
    if not method.other_decoder:
        own = "a closed form" if method.closed_form else "trained by gradients"
        raise ValueError(f"the decoder of method {name!r} is {own}: it has no decoder {decoder!r}")
    return lookup(METHODS, method.other_decoder, "method")
