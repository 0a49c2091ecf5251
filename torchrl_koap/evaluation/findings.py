# This source code is licensed under the MIT license found in the LICENSE file.
"""All thresholds and sentences of ``koap inspect`` and of offline evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from torchrl_koap.files import some
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.columns import thousandths

EXPERIMENTS = ("planner_alone", "controller_alone", "both")  # of ``koap inspect``, in the simulator
MODELS = ("koopman", "reconstruction", "linear", "copy_last")  # compared by their multi-step errors
OUTSIDE_THE_BUDGET = "outside_the_budget_for_analysis_only"  # key of results that read labels outside the budget
NEAR = 0.015  # m; largest distance at which a tool follows a recorded path well
GOOD = 0.9  # smallest success rate of a part that is not at fault
DATA = "fix what `koap validate` warns about"
MORE = f"{DATA}, then record more, or train longer (--steps) if plans were still improving"  # advice on plans
KIND = f"{DATA}, check --action-kind and --robot, or label a recording that moves it"  # advice on actions
ROUND = "round at another threshold, or choose the value in your driver; give each of several modes a 0/1 column"
UNSTABLE = 3.0  # late commands in a loop on labels, relative to the largest demonstrated one
HARDLY = 0.9  # share of the mean action's error above which a column is not learned, even if others are
_FAR = 3.0  # largest distance to the nearest recorded state, in standard deviations of these states
STAYS = 0.2  # smallest distance from the start, relative to that of demonstrations
LEAVES = "cut pauses at their ends (`koap convert --trim-still`), or train longer (--steps)"  # advice
_MAX_LEFT = 0.1  # share of recorded paths that a controller may leave
_ODD, _NOTABLE = 2.0, 0.5  # labels are odd above: multiple of the others' median error; relative error


def error_unit(part: str, task: Task) -> tuple[str, float]:
    """Returns the unit that shows errors of a part of the state (none if there are several) and the factor to it."""
    units = set(task.known_units[task.observation[part]])
    return thousandths(units.pop()) if len(units) == 1 else ("", 1.0)


def describe_inspection(result: Mapping[str, Any], task: Task) -> str:
    """Says what an inspection found: a sentence on the experiments, if there are any, and one on the latent space."""
    sentences = [_describe_experiments(result)] if "both" in result else []
    latent = result.get("latent", {})
    if "multi_step" in latent:
        sentences.append(_describe_latent(latent, task))
    elif not sentences:
        sentences.append(latent["note"])
    return ". ".join(sentences)


def _describe_experiments(result: Mapping[str, Any]) -> str:
    """Says which part fails in the three experiments.

    Recorded tool paths do not react to where pushed or grasped objects went. There, the controller is rated by how
    near the tool stays to the paths. A planner whose task has no goal is not rated.
    """
    planner, controller, both = (result[name]["rate"] if name in result else None for name in EXPERIMENTS)
    if both >= GOOD:
        return "no fault found: the closed loop succeeds"
    parts = [fault for fault in result.get("faults", ()) if "error of the environment" in fault]
    if planner is not None and planner < GOOD:
        parts.append(f"the planner alone reaches the goal in only {planner:.0%} of the episodes")
    if "recordings_left" in result:
        left, count = (result["recordings_left"][name] for name in ("count", "episodes"))
        if left > _MAX_LEFT * count:
            paths = f"{left} of {count} recorded tool paths"
            parts.append(f"the controller leaves {paths} by more than {1e3 * NEAR:.0f} mm")
    elif controller is not None and controller < GOOD:
        parts.append(f"the controller follows recorded states to the goal in only {controller:.0%}")
    distance = result["distance_to_demonstrations"]
    if distance and distance["visited_95"] > 2 * distance["demonstrated_95"]:
        parts.append("executed states lie far from every demonstration")
    if parts:
        return "; ".join(parts)
    if controller is None:
        return "planner and controller cannot be tried alone: this environment cannot start where a recording did"
    if planner is None:
        return "the controller works alone: the fault is in the planner, or in plans that start from executed states"
    return "planner and controller work alone, not together: plans that start from executed states are worse"


def offline_faults(
    plan: Mapping[str, Any], action: Mapping[str, Any], names: Mapping[int, str] | None = None
) -> list[str]:
    """Says which errors exceed those of baselines without learning, and which labels are odd.

    ``names`` are the names of trajectories in sentences, such as their files.
    """
    faults = _odd_labels(action.get("left_out", {}).get("trajectory", ()), names or {})
    for row in plan.get("unit", ()):
        own = row["planner"]["energy_score"]["overall"]
        for name in ("standing_still", "constant_velocity"):
            other = row[name]["energy_score"]["overall"]
            if own > other > 0:
                what = f"columns in {row['unit']}" if row["unit"] else "columns without a unit"
                against = _against(own, other, row["unit"])
                faults.append(f"plans are worse than {name.replace('_', ' ')} ({what}): {against}; {MORE}")
    where = {"outside_budget": "labels outside the budget", "left_out": "each labelled recording left out in turn"}
    for split, words in where.items():
        for row in action.get(split, {}).get("column", ()):
            if row["controller"] > HARDLY * row["mean_action"]:
                against = _against(row["controller"], row["mean_action"], row["unit"])
                how = "worse" if row["controller"] > row["mean_action"] else "hardly better"
                faults.append(f"action {row['name']} is {how} than always giving its mean ({words}): {against}; {KIND}")
            for each in row.get("values", ()):
                if 2 * each["nearest"] < each["labels"]:
                    faults.append(
                        f"action {row['name']} is predicted nearest to {each['value']:g} in only {each['nearest']} of"
                        f" {each['labels']} labels of that value ({words}): rounding seldom gives it; {ROUND}"
                    )
    return faults


def _odd_labels(rows: Sequence[Mapping[str, Any]], names: Mapping[int, str]) -> list[str]:
    """Names labelled recordings whose actions are predicted far worse than others when each is left out in turn."""
    errors = {row["episode"]: row["relative_action_error"] or 0.0 for row in rows}
    if len(errors) < 3:
        return []
    usual = {each: median([errors[it] for it in errors if it != each]) for each in errors}
    odd = [each for each, error in errors.items() if error > max(_ODD * usual[each], _NOTABLE)]
    odd = sorted(odd, key=errors.__getitem__, reverse=True)
    if not odd:
        return []
    said = some([f"{names.get(each, f'trajectory {each}')} ({errors[each]:.3g})" for each in odd])
    return [
        f"labels disagree with those of other recordings (each left out in turn; relative error, median of the others"
        f" {usual[odd[0]]:.3g}): {said}; check the sign, order of columns and offset in time of the first, unless no"
        " other label shows its motion"
    ]


def loop_faults(loop: Mapping[str, Any]) -> list[str]:
    """Says what is wrong with a policy in the loop of :func:`~torchrl_koap.evaluation.loop_on_labels.check_loop`."""
    late, distance, faults = loop["largest_command_late"], loop["distance_to_demonstrations"], []
    if late > UNSTABLE:
        faults.append(
            f"this policy is unstable: on a linear model of the robot, commands grow to {late:.3g} times the largest"
            f" demonstrated one within {loop['steps']} steps; check --action-kind, or label more recordings"
        )
    if distance > _FAR:
        faults.append(
            f"this policy leaves its demonstrations: on a linear model of the robot it ends {distance:.3g} standard"
            f" deviations from the nearest recorded state; {MORE}"
        )
    if loop["share_of_way"] < STAYS:
        faults.append(
            f"this policy does not leave the start: on a linear model of the robot it gets {loop['share_of_way']:.2g}"
            f" times as far as the demonstrations in {loop['steps']} steps; {LEAVES}"
        )
    return faults


def _describe_latent(latent: Mapping[str, Any], task: Task) -> str:
    errors = latent["multi_step"]
    part = next(iter(errors["koopman"]))
    shown, factor = error_unit(part, task)
    ahead = {model: f"{factor * errors[model][part][-1]:.3g} {shown}".rstrip() for model in MODELS}
    return (
        f"{errors['steps']} steps ahead the latent dynamics miss the {part.replace('_', ' ')} by {ahead['koopman']}"
        f" ({ahead['reconstruction']} of mapping back alone), a linear model on raw states by {ahead['linear']},"
        f" standing still by {ahead['copy_last']}; the policy does not use these predictions."
        f" {_describe_probe(latent[OUTSIDE_THE_BUDGET], task)}"
    )


def _describe_probe(outside: Mapping[str, Any], task: Task) -> str:
    if "note" in outside:
        return outside["note"].capitalize()
    shared, held_out = (outside.get(name, 0) for name in ("held_out_in_budget", "held_out_trajectories"))
    own, probe, hardest = min(zip(outside["decoder_r2"], outside["probe_r2"], task.action_names, strict=True))
    head, reservation = "Outside the budget, for evaluation only", ""
    if shared and shared == held_out:
        head = "On labels of the budget, which the run's decoder was fitted on"
    elif shared:
        reservation = f" ({shared} of these {held_out} have labels in the budget)"
    return (
        f"{head}: a linear probe on all labels explains {probe:.1%} of the hardest action, {hardest!r}, on"
        f" held-out trajectories, the run's own decoder {own:.1%}{reservation}"
    )


def _against(own: float, other: float, unit: str) -> str:
    shown, factor = thousandths(unit)
    return f"{own * factor:.4g} against {other * factor:.4g} {shown}".rstrip()
