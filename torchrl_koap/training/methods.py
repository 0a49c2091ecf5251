# This source code is licensed under the MIT license found in the LICENSE file.
"""All methods that the library compares, one entry each: the network, and what it is trained on.

A method from outside the package is registered the same way (:func:`register_method`), by a module that ``--plugin`` or
an entry point of the group ``torchrl_koap.methods`` names.

For a fair comparison, all controllers get the same labelled windows and the same planner. Each has the execution and
the number of updates that were best on demonstrations that no table uses (``benchmarks/tune_methods.py``). Two-stage
methods share their updates between the stages. Networks that may look ahead read the same frames, 4 before and up to 5
after the present one. Three are defined differently: Decision Diffuser's controller (``dd``, and ``relabel``, the same
trained on a teacher's actions) looks ahead to the next state only, ``koap_paper`` 8 steps; ``vae`` encodes the whole
window. ``dp`` and ``vpt`` train no planner, but use its network and its number of updates. Relabelling adds those of
the teacher.

``mpc`` is the only controller that is not an inverse dynamics model and shares nothing with KOAP: it follows plans with
an identified model of how the robot answers commands.

Four controls show what the Koopman model itself adds: ``linear``, the plain ridge on ``x_{t-1}, x_t, x_{t+8}`` with
none of KOAP's scales; ``linear_steps``, a ridge on what KOAP's latent action reads, with its scales and prior;
``koap_untrained``, KOAP with random features, where only the decoder is fitted;
``pca``, a ridge on principal components of all windows, labelled or not.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from torchrl_koap.lookup import check_free, entry_points_of, lookup
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
from torchrl_koap.objectives import ActionLoss, DiffusionPolicyLoss, KOAPLoss, QuantizedDynamicsLoss, VariationalLoss
from torchrl_koap.training.method import Method, Phase
from torchrl_koap.training.networks import build_sampler
from torchrl_koap.training.response import fit_response, tracked_columns

GROUP = "torchrl_koap.methods"  # of entry points


def _koap(task, columns, normalizers, preset, **overrides):
    return make_koopman_inverse_dynamics(len(columns), task.action_dim, preset=preset, **normalizers, **overrides)


def _response(task, columns, normalizers, preset):
    return ResponseModel(**tracked_columns(task), action_dim=task.action_dim)


def _linear(task, columns, normalizers, preset):
    return LinearInverseDynamics(len(columns), task.action_dim)


def _network(task, columns, normalizers, preset, *, kind, **options):
    return kind(len(columns), task.action_dim, **normalizers, **options)


_next_state = partial(_network, kind=SupervisedInverseDynamics, look_ahead=1)
_frames_ahead = partial(_network, kind=SupervisedInverseDynamics, look_ahead=(1, 2, 3, 4, 5))
_UNLABELLED = Phase("controller", partial(KOAPLoss, action_coeff=0.0))
_LABELS = (Phase("controller", ActionLoss, "labelled"),)
_JOINT = (Phase("controller", KOAPLoss, "mixed"),)
_TWO_STAGES = (replace(_UNLABELLED, share=0.5), Phase("finetune", KOAPLoss, "labelled", share=0.5))
# fits the decoder afterwards, with a frozen encoder
_DECODER = Phase("decoder", partial(ActionLoss, freeze_latents=True), "labelled", share=0.5)
_POLICY = (Phase("policy", DiffusionPolicyLoss, "labelled"),)

_ANY_PRESET = tuple(PRESETS)
_OPEN_LOOP = {"strategy": "open_loop"}
_AS_PLANNED = _OPEN_LOOP | {"blend": 0.0}
_BY_GRADIENTS: dict[str, Any] = {"presets": _ANY_PRESET, "updates": 1000, "execution": _AS_PLANNED}
_TAUGHT: dict[str, Any] = {"teacher": "dd_lookahead", "updates": 1000}

METHODS: dict[str, Method] = {}


def register_method(method: Method) -> Method:
    """Adds a method, which ``koap train --method``, curves and reports then find by its name.

    Args:
        method (Method): the method.

    Returns:
        Method: the same.

    Raises:
        ValueError: if the name is taken, or the teacher is unknown or not a controller.

    Examples:
        >>> from torchrl_koap.training.methods import METHODS, register_method
        >>> register_method(METHODS["koap"])  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: another method named 'koap' is registered already; choose another name, or first ...
    """
    check_free(METHODS, method.name, "method", "torchrl_koap.training.METHODS")
    if method.teacher and not lookup(METHODS, method.teacher, "teacher").plans:
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
        presets=_ANY_PRESET,
        phases_by_preset={"scene": (replace(_JOINT[0], windows="short"),)},  # labels shape the latent action, too
    ),
    Method(
        "mpc",
        "MPC with an identified response",
        _response,
        fit=lambda response, data, updates: fit_response(response, data),
        execution={"strategy": "feedback", "gain": 1.0},  # it knows its last command and predicts the robot's response
    ),
    Method("koap_sgd", "KOAP, decoder trained by gradients", _koap, _JOINT, **_BY_GRADIENTS),
    Method(
        "koap_paper",
        "KOAP as in the paper",
        _koap,
        _JOINT,
        presets=("paper",),
        columns="all",
        updates=1000,
        execution=_AS_PLANNED | {"temperature": 1.0, "candidates": 1},
    ),
    Method(
        "koap_labelled_only",
        "KOAP, labelled windows alone",
        _koap,
        (replace(_UNLABELLED, windows="labelled"),),
        closed_form=True,
        sees="labelled",
        presets=_ANY_PRESET,
    ),
    Method("koap_untrained", "KOAP, nothing trained but the decoder", _koap, closed_form=True, presets=_ANY_PRESET),
    Method("pretrain", "KOAP, pre-trained and fine-tuned", _koap, _TWO_STAGES, **_BY_GRADIENTS),
    Method(
        "linear_steps",
        "ridge on KOAP's scaled steps",
        partial(_koap, num_features=0, input_noise=1e-5),  # with KOAP's 1e-8 it fails more often on Avoiding
        closed_form=True,
    ),
    Method(
        "pca",
        "ridge on principal components of unlabelled windows",
        partial(_network, kind=PrincipalInverseDynamics),
        closed_form=True,
        look_ahead=8,
    ),
    Method("linear", "ridge on raw frames", _linear, closed_form=True, execution=_OPEN_LOOP),
    Method(
        "dd", "supervised, next state (Decision Diffuser)", _next_state, _LABELS, updates=1000, execution=_OPEN_LOOP
    ),
    Method("dd_lookahead", "supervised, look-ahead", _frames_ahead, _LABELS, updates=1000),
    Method(
        "vae",
        "variational autoencoder of whole windows",
        partial(_network, kind=VariationalInverseDynamics),
        (Phase("controller", VariationalLoss, share=0.5), _DECODER),
        updates=1000,
        execution=_OPEN_LOOP,
    ),
    Method(
        "lapo",
        "LAPO, quantised latent actions",
        partial(_network, kind=QuantizedInverseDynamics),
        (Phase("controller", QuantizedDynamicsLoss, share=0.5), _DECODER),
        updates=1000,
    ),
    Method(
        "nonlinear", "KOAP with nonlinear maps", partial(_network, kind=NonlinearInverseDynamics), _JOINT, updates=1000
    ),
    Method("dp", "Diffusion Policy", build_sampler, _POLICY, plans=False),
    Method("relabel", "Decision Diffuser on relabelled data", _next_state, _LABELS, execution=_OPEN_LOOP, **_TAUGHT),
    Method("vpt", "Diffusion Policy on relabelled data", build_sampler, _POLICY, plans=False, **_TAUGHT),
):
    register_method(_method)


def get_method(name: str) -> Method:
    """Looks up a method; the ValueError for an unknown name suggests the nearest."""
    if name not in METHODS:
        entry_points_of(GROUP)
    return lookup(METHODS, name, "method")
