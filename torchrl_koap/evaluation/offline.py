# This source code is licensed under the MIT license found in the LICENSE file.
"""Evaluation without an environment: errors of plans and actions on recorded data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.evaluation.config import EvalConfig
from torchrl_koap.evaluation.data_errors import errors_left_out, errors_of_chunks, errors_outside_budget, plan_errors
from torchrl_koap.evaluation.findings import offline_faults
from torchrl_koap.evaluation.loop_on_labels import check_loop
from torchrl_koap.files import DataError
from torchrl_koap.keys import ACTION, HAS_ACTION
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.training.datasets import split_held_out
from torchrl_koap.training.policy_facts import constant_actions
from torchrl_koap.training.trained import Trained

KIND = "offline"
SPLITS = ("outside_budget", "left_out")
_COMMANDS = "the controller decodes no recorded states: it follows plans from its own last command"


def evaluate_offline(trained: Trained, config: EvalConfig) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Evaluates a run on recorded data; raises an error if the data set is missing or changed.

    Plans are scored on held-out trajectories, which only chose the planner's weights. Actions are scored on labels
    outside the budget and, leaving out one trajectory at a time, inside it. The whole policy acts on a linear model of
    the robot's response.

    Returns:
        tuple: ``kind`` ``"offline"``, ``plan_errors``, ``action_errors`` and ``loop``, ``relative_plan_error`` (1: no
        better than standing still), ``relative_action_error`` (1: no better than always giving the mean action),
        ``faults`` in words, and a row per trajectory in ``trajectory``; ``predicted`` and ``true`` actions ``[N, act]``
        outside the budget, if there are any.
    """
    data = trained.data(config.dataset)
    labelled, _ = trained.hide_labels(data)
    plan = _plans(trained, data, config.seed)
    if trained.planner is not None:
        outside, tensors = _outside_budget(trained, data, labelled)
    else:
        outside, tensors = errors_of_chunks(trained.controller, data, labelled, trained.task, seed=config.seed), {}
    action = {"outside_budget": outside, "left_out": _left_out(trained, labelled, outside)}
    loop = check_loop(trained, data, labelled, execution=config.execution, seed=config.seed)
    return {
        "kind": KIND,
        "relative_plan_error": plan.get("relative"),
        "faults": offline_faults(plan, action, trained.names(data, config.dataset)) + loop.pop("faults"),
        "loop": loop,
        "plan_errors": plan,
        **_summary_of(action),
        # the linear model of the loop is fitted to all labels
        "labels_read_outside_budget": int(data[HAS_ACTION].sum() - labelled[HAS_ACTION].sum()),
        "trajectory": _per_trajectory(plan, action),
    }, tensors


def evaluate_actions(
    trained: Trained, dataset: str | None = None
) -> tuple[dict[str, Any], dict[str, Tensor], TensorDictBase | None]:
    """Compares decoded actions with labels outside the budget, for evaluation only, in addition to rollouts.

    If ``dataset`` is not given, and that of the training is missing, changed or damaged, a ``note`` says so: rollouts
    do not need it. A ``dataset`` other than that of the training raises an error. Returns ``action_errors`` with their
    summary and the actions, as :func:`evaluate_offline`, and the data that were read.
    """
    try:
        data: TensorDictBase | None = trained.data(dataset)
        outside, tensors = _outside_budget(trained, data, trained.hide_labels(data)[0])
    except (RunDirectoryError, DataError, FileNotFoundError) as error:
        if dataset is not None:
            raise
        data, outside, tensors = None, {"note": str(error)}, {}
    return _summary_of({"outside_budget": outside}), tensors, data


def _summary_of(action: Mapping[str, Any]) -> dict[str, Any]:
    split = next((name for name in SPLITS if "relative" in action.get(name, {})), None)
    outside = action["outside_budget"]
    return {
        "relative_action_error": None if split is None else action[split]["relative"],
        "action_errors_on": split,
        "labels_read_outside_budget": outside.get("labels", 0),
        "action_errors": dict(action),
    }


def _plans(trained: Trained, data: TensorDictBase, seed: int) -> dict[str, Any]:
    if trained.planner is None:
        return {"note": f"method {trained.config.method!r} samples actions: it makes no plans"}
    source = trained.config.planner.source
    if not trained.held_out and source is not None and trained.config.planner.held_out:
        return {"note": f"the recordings that {source} held out from its planner are not in this data set"}
    if not trained.held_out:
        return {"note": "no trajectory was held out from the planner (--planner.held-out; two trajectories at least)"}
    _, unseen, _ = split_held_out(data, trained.held_out)
    return {"trajectories": len(trained.held_out)} | plan_errors(trained.planner, unseen, trained.task, seed=seed)


def _outside_budget(
    trained: Trained, data: TensorDictBase, labelled: TensorDictBase
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    if trained.planner is None:
        return {"note": f"method {trained.config.method!r} samples actions: it decodes no recorded states"}, {}
    if trained.method.fit is not None:
        return {"note": _COMMANDS}, {}
    controller, repeated = trained.controller.cpu(), _repeated(trained, data)
    return errors_outside_budget(controller, trained.seen(data), trained.seen(labelled), trained.task, repeated)


def _left_out(trained: Trained, labelled: TensorDictBase, outside: Mapping[str, Any]) -> dict[str, Any]:
    if trained.planner is None:
        note = f"method {trained.config.method!r} would have to be trained again without each trajectory"
        hint = "; train it on fewer labels than there are (--labels): the others then measure it"
        return {"note": note + (hint if "note" in outside else "")}
    if trained.method.fit is not None:
        return {"note": _COMMANDS}
    if not trained.method.closed_form:
        return {"note": "the decoder is not fitted in closed form: leaving out a trajectory means training again"}
    controller, repeated = trained.controller.cpu(), _repeated(trained, labelled)
    return errors_left_out(controller, trained.seen(labelled), trained.task, trained.columns, repeated)


def _repeated(trained: Trained, data: TensorDictBase) -> list[int]:
    """Returns the action columns in which the policy commands one number, that of all labels."""
    steps = data[ACTION][data[HAS_ACTION].squeeze(-1)]
    known = constant_actions(trained.task, trained.results.get("command_ranges") or ())
    return [column for column, number in known.items() if (steps[:, column] == number).all()]


def _per_trajectory(plan: Mapping[str, Any], action: Mapping[str, Any]) -> list[dict[str, Any]]:
    parts = {"plans": plan} | {f"actions, {split.replace('_', ' ')}": action[split] for split in SPLITS}
    return [{"judged": name, **row} for name, part in parts.items() for row in part.get("trajectory", ())]
