# This source code is licensed under the MIT license found in the LICENSE file.
"""Fitting a controller's linear decoder on all labelled steps of a data set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_koap.data import cut_windows
from torchrl_koap.modules import KoopmanInverseDynamics, RidgeFit
from torchrl_koap.modules.koopman.action_decoder import INPUT_NOISE
from torchrl_koap.modules.koopman.smoothed_action import RAW
from torchrl_koap.tasks import Task

# one or two labelled trajectories cannot be left out to choose the penalty
DEFAULT_PENALTY = 0.15
PLACE_PENALTY = 1e-3  # the same where the present frame says most of the action
# the raw window of a smoothed latent action is read if its held-out error is below this share of the lifted one's:
# few labels left out say little, and unlabelled windows made the lifted one for the purpose
RAW_SHARE = 0.85


def fit_closed_form(
    controller: nn.Module,
    data: TensorDictBase,
    *,
    shared_axes: Sequence[int] = (),
    guessed_axes: Sequence[int] = (),
    input_noise: float = INPUT_NOISE,
) -> dict[str, Any]:
    """Fits a controller's linear decoder on every labelled step that sees its whole look-ahead, each used once.

    Args:
        controller (nn.Module): a :class:`KoopmanInverseDynamics`, :class:`LinearInverseDynamics`, or another controller
            with ``fit_decoder(windows, mask, groups=)``.
        data (TensorDictBase): flat data after the label budget was applied.

    Keyword Args:
        shared_axes (sequence of int): the state column that each action entry moves (``Task.moved_columns()``); used by
            Fourier latent actions (:meth:`KoopmanInverseDynamics.fit_decoder`).
        guessed_axes (sequence of int): the same where it is only likely; used if labels left out are predicted better
            by it. On a robot of seven joints with five labelled trajectories that is a fifth of the error.
        input_noise (float): errors of plans that a Koopman model's decoder allows for
            (:meth:`~torchrl_koap.modules.LinearActionDecoder.fit_ridge`).

    Returns:
        dict: penalty, number of labels and held-out error of the fit, or what another controller's fit returns.
    """
    names = {"state": getattr(controller, "in_key", "state"), "action": getattr(controller, "out_key", "action")}
    keys = ["state", "action", "has_action", "episode"]
    windows = cut_windows(data, controller.num_window_frames, select=keys, pad_before=controller.num_past)
    mask = windows["has_action"].squeeze(-1) & ~windows["padded"].squeeze(-1)
    # every step is frame `num_past` of one window; at other frames a clamped look-ahead would count it again
    mask[:, : controller.num_past], mask[:, controller.num_past + 1 :] = False, False
    groups = windows["episode"][:, -1]
    for name, own in names.items():
        if own != name:
            windows.rename_key_(name, own)
    if not isinstance(controller, KoopmanInverseDynamics):
        fit = controller.fit_decoder(windows, mask, groups=groups)
    elif controller.latent_action.choices:
        fit = _best_block(controller, windows, mask, groups, shared_axes, guessed_axes, input_noise)
    else:
        fit = _fit_koopman(controller, windows, mask, groups, shared_axes, guessed_axes, input_noise)
    if not isinstance(fit, RidgeFit):
        return dict(fit or {})
    # LAPACK's last digits depend on where memory lies: keep those that two equal runs share
    held_out = float(f"{fit.errors[fit.penalty]:.6g}")
    found = {"penalty": fit.penalty, "labels_used": fit.num_labels, "held_out_error": held_out}
    if isinstance(controller, KoopmanInverseDynamics) and controller.latent_action.choices:
        found["block"] = controller.latent_action.chosen
    return found


def _fit_koopman(
    controller: KoopmanInverseDynamics,
    windows: TensorDictBase,
    mask: Tensor,
    groups: Tensor,
    shared_axes: Sequence[int],
    guessed_axes: Sequence[int],
    input_noise: float,
) -> RidgeFit:
    """One fit, with tied axes where there are any: known ones, or likely ones if they help."""
    normalizer = controller.action_normalizer
    through_zero = normalizer is None or not normalizer.offset.any()
    penalty = PLACE_PENALTY if getattr(controller.latent_action, "place", 0.0) else DEFAULT_PENALTY
    options: dict[str, Any] = {
        "groups": groups,
        "default_penalty": penalty,
        "input_noise": input_noise,
        "bias": not through_zero,
    }
    if not (shared_axes or guessed_axes) or not controller.latent_action.holds_steps:
        return controller.fit_decoder(windows, mask, **options)
    options["tied_axes"] = shared_axes or guessed_axes
    fit = controller.fit_decoder(windows, mask, **options)
    return fit if shared_axes else _better_without(controller, fit, windows, mask, **options)


def _best_block(
    controller: KoopmanInverseDynamics,
    windows: TensorDictBase,
    mask: Tensor,
    groups: Tensor,
    shared_axes: Sequence[int],
    guessed_axes: Sequence[int],
    input_noise: float,
) -> RidgeFit:
    """Fits each block of a smoothed latent action; keeps the lifted one unless the other's held-out error says no."""
    chooser = controller.latent_action
    kept: tuple[float, str, RidgeFit, dict[str, Tensor]] | None = None
    for block in chooser.choices:
        chooser.choose(block)
        fit = _fit_koopman(controller, windows, mask, groups, shared_axes, guessed_axes, input_noise)
        error = fit.errors[fit.penalty] / (RAW_SHARE if block == RAW else 1.0)
        if kept is None or error < kept[0]:
            weights = {name: value.clone() for name, value in controller.action_decoder.state_dict().items()}
            kept = error, block, fit, weights
    assert kept is not None
    chooser.choose(kept[1])
    controller.action_decoder.load_state_dict(kept[3])
    return kept[2]


def likely_axes(task: Task, columns: Sequence[int]) -> list[int]:
    """The column that each action is likely to move, for a robot that came with data alone, which does not say it.

    Args:
        task (Task): the task.
        columns (sequence of int): state columns that the controller reads.

    Returns:
        list of int: a column of those read for every action; empty where there is nothing to guess.

    Examples:
        >>> from torchrl_koap.tasks import Action, Task, get_task
        >>> from torchrl_koap.training.closed_form import likely_axes
        >>> parts, actions = {"goal": 2, "q": 2}, {"a": Action("rad"), "b": Action("rad")}
        >>> arm = Task(name="arm", observation_parts=parts, actions=actions, position="q", robot=(2, 3))
        >>> likely_axes(arm, (2, 3)), likely_axes(get_task("avoiding"), (0, 1))
        ([0, 1], [])
    """
    moved = task.targets or task.robot
    if task.env is not None or len(moved) != task.action_dim or not set(moved) <= set(columns):
        return []
    return [list(columns).index(column) for column in moved]


def _better_without(
    controller: KoopmanInverseDynamics,
    fit: RidgeFit,
    windows: TensorDictBase,
    mask: Tensor,
    *,
    tied_axes: Sequence[int],
    **options: Any,
) -> RidgeFit:
    """Fits again without axes that are tied by a guess, and keeps the fit with the smaller held-out error."""
    tied = {name: value.clone() for name, value in controller.action_decoder.state_dict().items()}
    plain = controller.fit_decoder(windows, mask, **options)
    if plain.errors[plain.penalty] <= fit.errors[fit.penalty]:
        return plain
    controller.action_decoder.load_state_dict(tied)
    return fit
