# This source code is licensed under the MIT license found in the LICENSE file.
"""What the measurements of a latent space mean, in words; plain numbers in, no network needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torchrl_koap.tasks.units import thousandths

if TYPE_CHECKING:
    from torchrl_koap.tasks import Task

OUTSIDE_THE_BUDGET = "outside_the_budget_for_analysis_only"
MODELS = ("koopman", "reconstruction", "linear", "copy_last")
ON_THE_CIRCLE = 1e-3
"""Eigenvalues whose magnitude is nearer to 1 than this lie on the unit circle: in texts and pictures alike."""
_WORSE = 2.0  # from here on a latent model's error is no longer that of a comparable model


def unit_circle_sides(magnitudes: Sequence[float], *, tolerance: float = ON_THE_CIRCLE) -> list[str]:
    """Whether eigenvalues of these magnitudes lie ``"inside"``, ``"on"`` or ``"outside"`` the unit circle.

    Args:
        magnitudes (sequence of float): magnitudes ``[m]``.

    Keyword Args:
        tolerance (float): distance to the circle below which an eigenvalue lies on it.

    Examples:
        >>> from torchrl_koap.evaluation.latent_verdict import unit_circle_sides
        >>> unit_circle_sides([0.9, 0.9995, 1.2])
        ['inside', 'on', 'outside']
    """
    return ["outside" if size > 1 + tolerance else "inside" if size < 1 - tolerance else "on" for size in magnitudes]


def judge_latent_model(multi_step: Mapping[str, Any]) -> list[str]:
    """What is wrong with the latent dynamics as a model of the motion: an empty list if nothing is.

    The errors of the last predicted step are compared, by the first part of the state. A latent model is faulted for an
    error above twice that of a linear model on raw states (fitted on the same inputs), for one above standing still,
    and for losing more by mapping states back than the linear model errs in all.

    Args:
        multi_step (mapping): by model of :data:`MODELS` and part of the state the errors after 1, 2, ... steps, as of
            :func:`~torchrl_koap.evaluation.latent_space.prediction_errors`.

    Returns:
        list of str: a clause per fault, the worst first.

    Examples:
        >>> from torchrl_koap.evaluation.latent_verdict import judge_latent_model
        >>> errors = {"koopman": 2.0, "reconstruction": 0.5, "linear": 0.04, "copy_last": 9.0}
        >>> judge_latent_model({name: {"xy": [value]} for name, value in errors.items()})[0]
        'the latent dynamics predict 50 times worse than a linear model on raw states'
        >>> judge_latent_model({name: {"xy": [1.0]} for name in errors})
        []
    """
    part = next(iter(multi_step["koopman"]))
    koopman, back, linear, still = (float(multi_step[model][part][-1]) for model in MODELS)
    faults = []
    if not koopman < float("inf"):
        return ["the latent dynamics diverge: their prediction is not finite"]
    if koopman > still:
        faults.append(f"the latent dynamics predict {_times(koopman, still)} worse than standing still")
    if koopman > _WORSE * linear:
        faults.append(f"the latent dynamics predict {_times(koopman, linear)} worse than a linear model on raw states")
    if faults and back > _WORSE * linear:
        faults.append(f"mapping lifted states back alone loses {_times(back, linear)} what that linear model does")
    return faults


def error_unit(part: str, task: Task) -> tuple[str, float]:
    """Unit in which errors of a part of the state are shown, and the factor to it.

    Args:
        part (str): the part. Where the task says no units, positions are in m and joints in rad.
        task (Task): the task. A part whose columns have several units is shown without any.

    Examples:
        >>> from torchrl_koap.evaluation.latent_verdict import error_unit
        >>> from torchrl_koap.tasks import get_task
        >>> error_unit("measured_xy", get_task("avoiding")), error_unit("measured_joints", get_task("avoiding"))
        (('mm', 1000.0), ('mrad', 1000.0))
    """
    if not task.observation_units:
        if task.env is None:
            return "", 1.0
        return thousandths("rad" if "joints" in part else "m")
    units = set(task.observation_units[task.observation[part]])
    return thousandths(units.pop()) if len(units) == 1 else ("", 1.0)


def _times(large: float, small: float) -> str:
    return f"{large / small:.3g} times" if small > 0 else "infinitely"
