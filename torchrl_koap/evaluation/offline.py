# This source code is licensed under the MIT license found in the LICENSE file.
"""What a run is worth without an environment: plans and actions judged on recorded data, where rollouts would stand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import controller_view
from torchrl_koap.evaluation.chunk_errors import errors_of_chunks
from torchrl_koap.evaluation.label_errors import errors_left_out, errors_outside_budget
from torchrl_koap.evaluation.plan_errors import plan_errors
from torchrl_koap.evaluation.training_data import hide_labels_again, load_training_data
from torchrl_koap.tasks.units import thousandths
from torchrl_koap.training.closed_form import likely_axes

if TYPE_CHECKING:
    from torchrl_koap.evaluation.trained_run import TrainedRun

KIND = "offline"
SPLITS = ("outside_budget", "left_out")
_CHUNKS = ("policy", "mean_action")


def evaluate_offline(
    trained: TrainedRun, *, dataset: str | None = None, samples: int = 16, plans: int = 500, seed: int = 0
) -> dict[str, Any]:
    """Judges a run on recorded data.

    Plans are scored on the validation trajectories, which the planner has not seen
    (:func:`~torchrl_koap.evaluation.plan_errors.plan_errors`). Actions are decoded from recorded states and compared
    with labels outside the budget, if there are any, and with those inside it, a trajectory left out at a time
    (:mod:`~torchrl_koap.evaluation.label_errors`). A policy of its own is asked for chunks of actions in the situations
    outside the budget instead (:mod:`~torchrl_koap.evaluation.chunk_errors`).

    Args:
        trained (TrainedRun): the run.

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
    data = load_training_data(trained, dataset)
    labelled, _ = hide_labels_again(trained, data, dataset)
    plan = _plans(trained, data, samples=samples, plans=plans, seed=seed)
    action = _actions(trained, data, labelled, samples=samples, chunks=plans, seed=seed)
    split = next((name for name in SPLITS if "relative" in action[name]), None)
    return {
        "kind": KIND,
        "relative_plan_error": plan.get("relative"),
        "relative_action_error": None if split is None else action[split]["relative"],
        "action_errors_on": split,
        "faults": find_faults(plan, action),
        "plan_errors": plan,
        "action_errors": action,
        "trajectory": _per_trajectory(plan, action),
    }


def _plans(trained: TrainedRun, data: TensorDictBase, **options: Any) -> dict[str, Any]:
    if trained.planner is None:
        return {"note": f"method {trained.config['method']!r} is a policy of its own: it makes no plans"}
    held_out = trained.config.get("validation_episodes") or []
    if not held_out:
        return {
            "note": "no trajectory was held out from the planner (--validation-fraction; two trajectories at least)"
        }
    unseen = data[torch.isin(data["episode"], torch.tensor(held_out))]
    return {"trajectories": len(held_out)} | plan_errors(trained.planner, unseen, trained.task, **options)


def _actions(trained: TrainedRun, data: TensorDictBase, labelled: TensorDictBase, **options: Any) -> dict[str, Any]:
    task = trained.task
    if trained.planner is None:
        outside = errors_of_chunks(trained.controller, data, labelled, task, **options)
        note = f"method {trained.config['method']!r} would have to be trained again without each trajectory"
        hint = "; train it on fewer labels than there are (--label-count): the others tell how good it is"
        return {"outside_budget": outside, "left_out": {"note": note + (hint if "note" in outside else "")}}
    view, seen = (controller_view(part, trained.columns, action_targets=task.targets) for part in (data, labelled))
    controller = trained.controller.cpu()
    return {
        "outside_budget": errors_outside_budget(controller, view, seen, task),
        "left_out": errors_left_out(
            controller,
            seen,
            task,
            closed_form=trained.method.closed_form,
            guessed_axes=likely_axes(task, trained.columns),
        ),
    }


def _per_trajectory(plan: Mapping[str, Any], action: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = [{"judged": "plans", **row} for row in plan.get("trajectory", ())]
    for split in SPLITS:
        rows += [
            {"judged": f"actions, {split.replace('_', ' ')}", **row} for row in action[split].get("trajectory", ())
        ]
    return rows


def find_faults(plan: Mapping[str, Any], action: Mapping[str, Any]) -> list[str]:
    """What is wrong with a run by its offline figures, a sentence each: worse than what needs no learning at all.

    Args:
        plan (mapping): of :func:`~torchrl_koap.evaluation.plan_errors.plan_errors`, or a note.
        action (mapping): by split, of :func:`~torchrl_koap.evaluation.label_errors.summarise_errors`, or a note.

    Examples:
        >>> from torchrl_koap.evaluation.offline import find_faults
        >>> row = {"name": "dq1", "unit": "rad", "controller": 0.004, "mean_action": 0.003}
        >>> find_faults({"note": ""}, {"left_out": {"column": [row]}, "outside_budget": {"note": ""}})
        ['action dq1 is worse than always giving its mean (labelled trajectories left out): 4 against 3 mrad']
    """
    faults = []
    for row in plan.get("unit", ()):
        own = row["planner"]["energy_score"]["overall"]
        for name in ("standing_still", "constant_velocity"):
            other = row[name]["energy_score"]["overall"]
            if own > other > 0:
                against = _against(own, other, row["unit"])
                what = f"columns in {row['unit']}" if row["unit"] else "columns without a unit"
                faults.append(f"plans are worse than {name.replace('_', ' ')} ({what}): {against}")
    where = {"outside_budget": "labels outside the budget", "left_out": "labelled trajectories left out"}
    for split in SPLITS:
        for row in action.get(split, {}).get("column", ()):
            if row["controller"] > row["mean_action"]:
                against = _against(row["controller"], row["mean_action"], row["unit"])
                faults.append(f"action {row['name']} is worse than always giving its mean ({where[split]}): {against}")
    return faults


def _against(own: float, other: float, unit: str) -> str:
    shown, factor = thousandths(unit)
    return f"{own * factor:.3g} against {other * factor:.3g} {shown}".rstrip()


def describe_offline(result: Mapping[str, Any]) -> str:
    """The figures in words, a line per unit, for a terminal.

    Args:
        result (mapping): of :func:`evaluate_offline`.
    """
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
