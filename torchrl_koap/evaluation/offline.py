# This source code is licensed under the MIT license found in the LICENSE file.
"""What a run is worth without an environment: plans and actions judged on recorded data, where rollouts would stand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase

from torchrl_koap.data import controller_view, select_trajectories
from torchrl_koap.evaluation.action_errors import errors_left_out, errors_of_chunks, errors_outside_budget
from torchrl_koap.evaluation.findings import offline_faults
from torchrl_koap.evaluation.plan_errors import plan_errors
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.runs.weights import save_tensors
from torchrl_koap.tasks.units import thousandths

if TYPE_CHECKING:
    from torchrl_koap.training.trained import Trained

KIND = "offline"
SPLITS = ("outside_budget", "left_out")
_CHUNKS = ("policy", "mean_action")
_COMMANDS = "the controller decodes no recorded states: it follows plans by the command that it gave"


def evaluate_offline(
    trained: Trained, *, dataset: str | None = None, samples: int = 16, plans: int = 500, seed: int = 0
) -> dict[str, Any]:
    """Judges a run on recorded data.

    Plans are scored on the validation trajectories, which the planner has not seen
    (:func:`~torchrl_koap.evaluation.plan_errors.plan_errors`). Actions are decoded from recorded states and compared
    with labels outside the budget, if there are any, and with those inside it, a trajectory left out at a time
    (:mod:`~torchrl_koap.evaluation.action_errors`). A policy of its own samples chunks of actions outside the budget.

    Args:
        trained (Trained): the run.

    Keyword Args:
        dataset (str, optional): where its data set is now. Default: where it was.
        samples (int): plans per situation.
        plans (int): situations at most.
        seed (int): seed of the plans' noise.

    Returns:
        dict: ``kind`` ``"offline"``, ``plan_errors`` and ``action_errors``, ``relative_plan_error`` (1: no better than
        standing still), ``relative_action_error`` (1: no better than always giving the mean action), ``faults`` in
        words, and a row per trajectory in ``trajectory``.

    Raises:
        RunDirectoryError: if the data set has moved, or is another one.
    """
    data = trained.data(dataset)
    labelled, _ = trained.hide_labels(data)
    plan = _plans(trained, data, samples=samples, plans=plans, seed=seed)
    if trained.planner is None:
        outside = errors_of_chunks(
            trained.controller, data, labelled, trained.task, samples=samples, chunks=plans, seed=seed
        )
    else:
        outside = _outside_budget(trained, data, labelled)
    action = {"outside_budget": outside, "left_out": _left_out(trained, labelled, outside)}
    return {
        "kind": KIND,
        "relative_plan_error": plan.get("relative"),
        "faults": offline_faults(plan, action),
        "plan_errors": plan,
        **_summary_of(action),
        "trajectory": _per_trajectory(plan, action),
    }


def evaluate_actions(trained: Trained, dataset: str | None = None) -> dict[str, Any]:
    """Compares decoded actions with labels outside the budget, for evaluation only, beside rollouts in an environment.

    Args:
        trained (Trained): the run.
        dataset (str, optional): where its data set is now. Default: where it was; if it is not there, nothing is read.

    Returns:
        dict: ``action_errors`` and what they come to, as of :func:`evaluate_offline`.

    Raises:
        RunDirectoryError: if the data set that was named is not that of the training.
    """
    try:
        data = trained.data(dataset)
        outside = _outside_budget(trained, data, trained.hide_labels(data)[0])
    except RunDirectoryError as error:
        if dataset is not None:
            raise
        outside = {"note": str(error)}
    return _summary_of({"outside_budget": outside})


def _summary_of(action: Mapping[str, Any]) -> dict[str, Any]:
    split = next((name for name in SPLITS if "relative" in action.get(name, {})), None)
    return {
        "relative_action_error": None if split is None else action[split]["relative"],
        "action_errors_on": split,
        "labels_read_outside_budget": action["outside_budget"].get("labels", 0),
        "action_errors": dict(action),
    }


def _plans(trained: Trained, data: TensorDictBase, **options: Any) -> dict[str, Any]:
    if trained.planner is None:
        return {"note": f"method {trained.config.method!r} is a policy of its own: it makes no plans"}
    if not trained.held_out:
        return {"note": "no trajectory was held out from the planner (--planner.held-out; two trajectories at least)"}
    unseen = select_trajectories(data, trained.held_out)
    return {"trajectories": len(trained.held_out)} | plan_errors(trained.planner, unseen, trained.task, **options)


def _outside_budget(trained: Trained, data: TensorDictBase, labelled: TensorDictBase) -> dict[str, Any]:
    """Errors of decoded actions; writes ``actions.safetensors``."""
    if trained.planner is None:
        return {"note": f"method {trained.config.method!r} samples actions: it decodes no recorded states"}
    if trained.method.fit is not None:
        return {"note": _COMMANDS}
    view, seen = (controller_view(part, trained.columns, targets=trained.task.targets) for part in (data, labelled))
    errors, tensors = errors_outside_budget(trained.controller.cpu(), view, seen, trained.task)
    if tensors:
        save_tensors(trained.folder / "actions.safetensors", tensors)
    return errors


def _left_out(trained: Trained, labelled: TensorDictBase, outside: Mapping[str, Any]) -> dict[str, Any]:
    if trained.planner is None:
        note = f"method {trained.config.method!r} would have to be trained again without each trajectory"
        hint = "; train it on fewer labels than there are (--labels): the others tell how good it is"
        return {"note": note + (hint if "note" in outside else "")}
    if trained.method.fit is not None:
        return {"note": _COMMANDS}
    if not trained.method.closed_form:
        return {"note": "the decoder is not fitted in closed form: leaving a trajectory out would mean to train again"}
    seen = controller_view(labelled, trained.columns, targets=trained.task.targets)
    return errors_left_out(trained.controller.cpu(), seen, trained.task, trained.columns)


def _per_trajectory(plan: Mapping[str, Any], action: Mapping[str, Any]) -> list[dict[str, Any]]:
    parts = {"plans": plan} | {f"actions, {split.replace('_', ' ')}": action[split] for split in SPLITS}
    return [{"judged": name, **row} for name, part in parts.items() for row in part.get("trajectory", ())]


def describe_offline(result: Mapping[str, Any]) -> str:
    """Says the figures of :func:`evaluate_offline` in words, a line per unit, for a terminal."""
    lines = ["judged on recorded data: the task has no environment"]
    plan, action = result["plan_errors"], result["action_errors"]
    lines += [f"plans: {plan['note']}"] if "note" in plan else []
    for row in plan.get("unit", ()):
        shown, factor = thousandths(row["unit"])
        values = [
            f"{name.replace('_', ' ')} {factor * row[name]['energy_score']['overall']:.4g}"
            for name in ("planner", "standing_still", "constant_velocity")
        ]
        lines.append(f"plans, energy score{f' ({shown})' if shown else ''}: {', '.join(values)}")
    for split in SPLITS:
        head = f"actions, {split.replace('_', ' ')}"
        lines += [f"{head}: {action[split]['note']}"] if "note" in action[split] else []
        for row in action[split].get("unit", ()):
            shown, factor = thousandths(row["unit"])
            values = [
                f"{name.replace('_', ' ')} {factor * row[name]:.4g}" for name in ("controller", "ridge", "mean_action")
            ]
            lines.append(f"{head}, RMSE{f' ({shown})' if shown else ''}: {', '.join(values)}")
        lines += _describe_chunks(action[split].get("chunk", {}))
    return "\n".join([*lines, *(f"FAULT: {fault}" for fault in result["faults"])])


def _describe_chunks(chunk: Mapping[str, Any]) -> list[str]:
    lines = []
    for row in chunk.get("unit", ()):
        shown, factor = thousandths(row["unit"])
        values = [f"{name.replace('_', ' ')} {factor * row[name]['energy_score']['overall']:.4g}" for name in _CHUNKS]
        best = f"best of {chunk['samples']} {factor * row['policy']['best_of']['overall']:.4g}"
        unit = f" ({shown})" if shown else ""
        lines.append(f"whole chunks of actions, energy score{unit}: {', '.join(values)}; {best}")
    return lines
