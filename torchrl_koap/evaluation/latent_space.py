# This source code is licensed under the MIT license found in the LICENSE file.
"""Analyses a trained Koopman model: its spectrum, its multi-step errors, and what its latent actions hold.

Spectrum and multi-step errors need no label. The linear probe tests whether true actions are a linear function of
latent actions. It reads every label, in the budget or not; therefore its result must only be reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_koap.data import WindowTable
from torchrl_koap.data.trajectories import labelled_episodes, trajectory_lengths
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.evaluation.findings import MODELS, OUTSIDE_THE_BUDGET
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, STATE
from torchrl_koap.modules import KoopmanInverseDynamics
from torchrl_koap.modules.ridge import ridge

HORIZON = 10  # control steps
_MOST_WINDOWS = 20000  # more of them change no shown digit of the errors


@torch.no_grad()
def infer_steps(controller: KoopmanInverseDynamics, data: TensorDictBase, *, every: int = 1) -> TensorDict:
    """Infers latent actions of all steps with a whole look-ahead, each once: the steps that a decoder is fitted to.

    Reads one step in ``every``. Returns entries ``[M]``: ``latent_action [M, m]``, ``action``, ``has_action [M]``,
    ``episode [M]``.
    """
    now = controller.num_past
    table = WindowTable.build(data, controller.num_window_frames, pad_before=now)
    states, rows = data[STATE], torch.arange(0, len(table.starts), every, device=table.starts.device)
    latent = [controller.infer(states[table.frames(part)[0]], range(now, now + 1))[:, 0] for part in rows.split(4096)]
    here = data[table.starts[rows] + now]
    entries = {"latent_action": torch.cat(latent)} | {key: here[key] for key in (ACTION, EPISODE)}
    return TensorDict(entries | {HAS_ACTION: here[HAS_ACTION].squeeze(-1)}, [len(rows)])


def split_trajectories(episode: Tensor, labelled: Tensor) -> Tensor:
    """Draws half of the trajectories to fit on, first those with a label in the budget; returns their numbers.

    The other half is then new to a decoder fitted within the budget, unless the budget labels more than half of them.
    ``episode [N]`` and ``labelled [N]`` are the trajectory of every step and whether the budget labels it.
    """
    names = episode.unique()
    if len(names) < 2:
        raise ValueError("fitting on half of the trajectories needs at least two, got 1")
    order = names[torch.randperm(len(names), generator=torch.Generator().manual_seed(0))]
    in_budget = torch.isin(order, episode[labelled].unique())
    return torch.cat([order[in_budget], order[~in_budget]])[: len(names) // 2]


@torch.no_grad()
def prediction_errors(
    controller: KoopmanInverseDynamics,
    data: TensorDictBase,
    fit_on: Tensor,
    parts: Mapping[str, Sequence[int]],
    *,
    horizon: int,
) -> dict[str, dict[str, list[float]]]:
    r"""Measures errors of predicted states ``1 .. horizon`` steps ahead for three models.

    * ``koopman``: :math:`z_{t+1} = K z_t + B u_t` from :math:`z_t = g_\theta(x_t)`, mapped back by :math:`g_\psi`;
    * ``linear``: :math:`x_{t+1} = A x_t + C v_t + c` by least squares, where ``v_t`` are the frames that ``u_t`` reads:
      the same inputs, no lifting;
    * ``copy_last``: :math:`x_{t+h} = x_t`.

    ``reconstruction``, :math:`g_\psi(g_\theta(x_{t+h}))`, is the part of the first one's error due to mapping back.

    Both ``u`` and ``v`` read recorded states *ahead* of every step, so this tests the models; it is no forecast. The
    linear model is fitted on the trajectories ``fit_on``, and all three are tested on the others. The training of the
    Koopman model has seen most of these.

    Returns, by model and part, the root mean square distance after ``1 .. horizon`` steps, in raw units. A horizon that
    exceeds a trajectory is an error.
    """
    now, length = controller.num_past, controller.num_window_frames + horizon - 1
    table = WindowTable.build(data, length, pad_before=now)
    fitted = torch.isin(data[EPISODE][table.first], fit_on)
    known, new = (rows.nonzero().squeeze(-1) for rows in (fitted, ~fitted))
    linear = _fit_linear(controller, data[STATE][table.frames(spread_evenly(known, 10 * _MOST_WINDOWS))[0]])
    new = data[STATE][table.frames(new[:: -(-len(new) // _MOST_WINDOWS)])[0]]
    sums = {model: torch.zeros(horizon, new.shape[-1], dtype=torch.float64) for model in MODELS}
    frames = range(now, now + horizon)
    for states in new.split(1024):
        true = states[:, now + 1 : now + 1 + horizon]
        lifted = controller.lift(states[:, : now + 1 + horizon])
        rolled = [lifted[:, now]]
        for latent_action in controller.infer(states, frames).unbind(1):
            rolled.append(controller.predict_next(rolled[-1], latent_action))
        paths = torch.stack(rolled[1:], 1), lifted[:, now + 1 :]
        decoded = [controller.lifting.decode(path) for path in paths]
        predicted = {
            "koopman": _raw(controller, decoded[0]),
            "reconstruction": _raw(controller, decoded[1]),
            "linear": _raw(controller, _roll_linear(controller, linear, states, frames)),
            "copy_last": states[:, now : now + 1].expand_as(true),
        }
        for model, states_of in predicted.items():
            sums[model] += (states_of - true).double().square().sum(0)
    return {
        model: {name: (total[:, list(columns)].sum(-1) / len(new)).sqrt().tolist() for name, columns in parts.items()}
        for model, total in sums.items()
    }


def _raw(controller: KoopmanInverseDynamics, state: Tensor) -> Tensor:
    return state if controller.state_normalizer is None else controller.state_normalizer.inverse(state)


def _frames_read(controller: KoopmanInverseDynamics, states: Tensor, frames: range) -> Tensor:
    """Returns the inputs of latent actions of some frames, flat, with a constant column: ``[B, len(frames), .]``."""
    read = controller.latent_action.gather(controller.normalize_state(states), frames).flatten(-2).double()
    return torch.cat([read, torch.ones_like(read[..., :1])], -1)


def _fit_linear(controller: KoopmanInverseDynamics, states: Tensor) -> Tensor:
    now = controller.num_past
    normalized = controller.normalize_state(states).double()
    inputs = torch.cat([normalized[:, now], _frames_read(controller, states, range(now, now + 1))[:, 0]], -1)
    # x_t is among the frames read, so inputs are collinear: only an SVD finds the minimum-norm solution
    return torch.linalg.lstsq(inputs, normalized[:, now + 1], driver="gelsd").solution


def _roll_linear(controller: KoopmanInverseDynamics, weight: Tensor, states: Tensor, frames: range) -> Tensor:
    state = controller.normalize_state(states)[:, frames.start].double()
    rolled = []
    for read in _frames_read(controller, states, frames).unbind(1):
        state = torch.cat([state, read], -1) @ weight
        rolled.append(state)
    return torch.stack(rolled, 1)


def explained(predicted: Tensor, true: Tensor) -> list[float]:
    """Returns the explained share ``R^2`` of the variance of every column ``[N, a]``; NaN without variance."""
    left = (predicted - true).double().square().sum(0)
    spread = (true - true.mean(0)).double().square().sum(0)
    return torch.where(spread > 0, 1 - left / spread, torch.nan).tolist()


def probe(latent: Tensor, action: Tensor, groups: Tensor, fit: Tensor) -> list[float]:
    """Returns the ``R^2`` of a linear map from latent ``[N, m]`` to true actions ``[N, act]``; reads all of them.

    The map is fitted on the steps ``fit`` (bool ``[N]``) and tested on the others. ``groups`` are the trajectories
    ``[N]`` that cross-validation of the ridge leaves out.
    """
    return explained(ridge(latent[fit], action[fit], groups=groups[fit]).predict(latent[~fit]), action[~fit])


def analyse_latent(
    controller: KoopmanInverseDynamics, data: TensorDictBase, labelled: Tensor, parts: Mapping[str, Sequence[int]]
) -> dict[str, Any]:
    """Measures eigenvalues, multi-step errors (fewer steps for short trajectories) and the ``R^2`` of a linear probe.

    The flat data ``[N]``, as the controller sees them, have all labels. ``labelled`` marks those in the budget, bool
    ``[N]``; ``parts`` are columns of the state by name.

    Returns:
        dict: ``eigenvalues``, ``multi_step``, and under :data:`OUTSIDE_THE_BUDGET` the probe, the number of labels it
        read and the ``R^2`` of the model's own decoder on the same steps; or a ``note`` if fewer than two trajectories
        have labels.
    """
    eigenvalues = controller.operator.eigenvalues().detach()
    result: dict[str, Any] = {"eigenvalues": {"real": eigenvalues.real.tolist(), "imag": eigenvalues.imag.tolist()}}
    fit_on = split_trajectories(data[EPISODE], labelled)
    reach = controller.num_window_frames - 1 - controller.num_past
    horizon = min(HORIZON, max(1, int(trajectory_lengths(data).min()) - reach))
    held_out = int(len(data[EPISODE].unique()) - len(fit_on))
    errors = prediction_errors(controller, data, fit_on, parts, horizon=horizon)
    result["multi_step"] = {"steps": horizon, "held_out_trajectories": held_out} | errors
    known = labelled_episodes(data)
    if len(known) < 2:
        note = "fewer than two trajectories have labels to probe latent actions with"
        return result | {OUTSIDE_THE_BUDGET: {"note": note}}
    steps = infer_steps(controller, data[torch.isin(data[EPISODE], known)])
    steps = steps[steps[HAS_ACTION]]
    if not data[HAS_ACTION].all():  # the recordings themselves lack some actions
        fit_on = split_trajectories(steps[EPISODE], torch.zeros(len(steps), dtype=torch.bool))
    latent, action, fit = steps["latent_action"], steps[ACTION], torch.isin(steps[EPISODE], fit_on)
    budget = data[EPISODE][labelled].unique()
    with torch.no_grad():
        decoded = controller.raw_action(controller.decode(latent[~fit]))
        own = explained(decoded, action[~fit])
    result[OUTSIDE_THE_BUDGET] = {
        "labels_read": len(steps),
        "held_out_trajectories": len(steps[EPISODE][~fit].unique()),
        "held_out_in_budget": int((~torch.isin(budget, fit_on)).sum()),
        "probe_r2": probe(latent, action, steps[EPISODE], fit),
        "decoder_r2": own,
    }
    return result
