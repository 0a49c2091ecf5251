# This source code is licensed under the MIT license found in the LICENSE file.
"""The one-page report of a run directory: what a template needs, gathered from the files that are there."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_koap.reports.advice import advice
from torchrl_koap.reports.html import write_page
from torchrl_koap.reports.pictures import EVAL, FOLDER, TRAIN, all_pictures, draw_pictures
from torchrl_koap.reports.run_facts import RunFacts, number
from torchrl_koap.tasks.columns import thousandths

_ENTROPIES = {"mode_entropy": "mode entropy", "pooled_mode_entropy": "mode entropy, all contexts together"}
_PLAN_BASELINES = ("standing_still", "constant_velocity")
_SIMULATED = ("rollouts.safetensors", "inspect.json")
_BESIDE_LABELS = "demonstrations.png"
_EVAL_ELSEWHERE = ("episode", "trajectory", "faults", "rates", "action_errors")
_CONFIG_ELSEWHERE = ("versions", "command")


def write_report(folder: str | Path, *, draw: bool = True, animation: bool = True) -> Path:
    """Writes ``index.html`` into a run directory; sections whose files are absent say which command makes them.

    Pictures are drawn first (``draw``; otherwise those already there are shown), moving ones too (``animation``).

    Raises:
        FileNotFoundError: if there is no such directory.
    """
    run = RunFacts.read(folder)
    problems = draw_pictures(run.folder, animation=animation) if draw else {}
    for problem in problems.values():
        warnings.warn(problem, stacklevel=2)
    config, summary, evaluation = run.config, run.summary, run.evaluation
    figures, missing = _figures(run, problems)
    commands = {"train": TRAIN, "eval": "koap eval {run}" if run.offline else EVAL}
    return write_page(
        "run.html",
        run.folder / "index.html",
        title=" on ".join(str(config[key]) for key in ("method", "task") if config.get(key)) or "run",
        subtitle=_subtitle(run),
        notes=[*problems.values(), *run.damaged, *(evaluation.get("faults") or ())],
        tiles=_tiles(run),
        evaluated=bool(evaluation),
        commands={name: _filled(command, run) for name, command in commands.items()},
        advice=[
            {"finding": item.finding, "proposal": item.proposal, "command": _filled(item.command, run)}
            for item in advice(run)
        ],
        labels=summary.get("labels"),
        labels_read=run.evaluated("labels_read_outside_budget"),
        label_figure=next((item for item in figures if item["name"] == _BESIDE_LABELS), None),
        figures=[item for item in figures if item["name"] != _BESIDE_LABELS],
        missing=missing,
        numbers=[
            (head, shown)
            for head, source, elsewhere in (
                ("Evaluation", evaluation, _EVAL_ELSEWHERE),
                ("Training", summary, ("labels", "command_ranges")),
            )
            if (shown := {key: value for key, value in source.items() if key not in elsewhere})
        ],
        episodes=evaluation.get("episode") or evaluation.get("trajectory"),
        again=_again(run),
        configured=bool(config),
        has_command=_given(config, "command"),
        versions=config.get("versions"),
        options={key: value for key, value in config.items() if key not in _CONFIG_ELSEWHERE},
    )


def _subtitle(run: RunFacts) -> str:
    shown = []
    for option in ("controller.preset", "dataset", "run.seed"):
        section, _, name = option.rpartition(".")
        options = run.config.get(section) if section else run.config
        if isinstance(options, Mapping) and _given(options, name):
            shown.append(f"{name} {options[name]}")
    return " · ".join([str(run.folder), *shown])


def _figures(run: RunFacts, problems: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, list[str]]]:
    """What is to be shown, and for each command the titles of the pictures whose source it would leave."""
    outside = run.action_errors.get("outside_budget")
    no_actions = outside.get("note") if isinstance(outside, Mapping) else None
    figures: list[dict[str, Any]] = []
    missing: dict[str, list[str]] = {}
    for name, item in all_pictures().items():
        source = (run.folder / item.source).exists()
        figure: dict[str, Any] = {"name": name, "title": item.title, "caption": item.caption_for(run), "empty": ""}
        if name in problems:
            continue
        if (run.folder / FOLDER / name).exists():
            figures.append(figure | {"source": f"{FOLDER}/{name}", "beside": name.endswith(".gif")})
        elif (item.source in _SIMULATED) if run.offline else item.offline:
            continue  # no command makes it for this task
        elif item.source == "actions.safetensors" and not source and isinstance(no_actions, str):
            figures.append(figure | {"empty": no_actions})  # no command would make it
        elif not source:
            missing.setdefault(_filled(item.made_by, run), []).append(item.title)
        elif item.empty:
            figures.append(figure | {"empty": item.empty})
    return figures, missing


def _again(run: RunFacts) -> list[str]:
    """Command lines that train and evaluate the run again."""
    trained = [str(run.config["command"])] if _given(run.config, "command") else []
    return trained + ([_eval_command(run)] if run.evaluation else [])


def _eval_command(run: RunFacts) -> str:
    evaluation = run.evaluation
    words = ["koap", "eval", str(run.folder)]
    if evaluation.get("kind") == "offline":
        evaluation = {"seed": evaluation.get("seed")}
    episode = evaluation.get("episode")
    first = episode[0] if isinstance(episode, list) and episode and isinstance(episode[0], Mapping) else {}
    options = {"episodes": evaluation.get("episodes"), "seed": evaluation.get("seed", first.get("seed"))}
    options |= dict(run.execution) | {key: evaluation.get(key) for key in ("env", "success_key")}
    for key, value in options.items():
        if value is not None:
            words += [f"--{key.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _filled(command: str, run: RunFacts) -> str:
    return command.format(run=shlex.quote(str(run.folder)))


def _given(source: Mapping[str, Any], key: str) -> bool:
    return source.get(key) not in (None, "", [], {})


def _tiles(run: RunFacts) -> list[dict[str, Any]]:
    """Returns name, value, note and bar (or None) of every headline number of a run."""
    found = [*_offline_errors(run), *_rates(run), _entropy(run), _speed(run)]
    return [item for item in found if item is not None]


def _tile(name: str, value: str, note: str, interval: tuple[float, ...] | None = None) -> dict[str, Any]:
    return {"name": name, "value": value, "note": note, "bar": interval}


def _offline_errors(run: RunFacts) -> list[dict[str, Any]]:
    """Errors of plans and actions on recorded data."""
    found, evaluation = [], run.evaluation
    for row in evaluation.get("plan_errors", {}).get("unit", ()):
        shown, factor = thousandths(row["unit"])
        values = {name: factor * row[name]["energy_score"]["overall"] for name in ("planner", *_PLAN_BASELINES)}
        note = ", ".join(f"{name.replace('_', ' ')} {values[name]:.3g}" for name in _PLAN_BASELINES)
        head = f"plan error, energy score, {len(row['columns'])} columns"
        found.append(_tile(head, f"{values['planner']:.3g} {shown}".rstrip(), note))
    split = evaluation.get("action_errors_on")
    errors = run.action_errors[split] if split else {}
    for row in errors.get("unit", ()):
        shown, factor = thousandths(row["unit"])
        others = [f"{name.replace('_', ' ')} {factor * row[name]:.3g}" for name in ("ridge", "mean_action")]
        others.append(f"n = {errors['labels']:,} labels, {split.replace('_', ' ')}")
        head = f"action error, {len(row['columns'])} columns"
        found.append(_tile(head, f"{factor * row['controller']:.3g} {shown}".rstrip(), ", ".join(others)))
    return found


def _rates(run: RunFacts) -> list[dict[str, Any]]:
    """Shares of the rollouts: success, and those that the task's own score adds."""
    contexts, found = run.evaluated("contexts"), []
    for name, values in run.rates.items():
        rate, low, high, total = (number(values.get(key)) for key in ("rate", "low", "high", "episodes"))
        if rate is None:
            continue
        notes, interval = [], None
        if low is not None and high is not None:
            notes = [f"95 % interval {100 * low:.1f} to {100 * high:.1f} %"]
            interval = tuple(100 * min(max(part, 0.0), 1.0) for part in (rate, low, high))
        if total:
            among = f" in {contexts:g} contexts" if contexts and name == "success" else ""
            notes.append(f"{round(rate * total)} of {total:g} rollouts{among}")
        found.append(_tile(name, f"{100 * rate:.1f} %", ", ".join(notes), interval))
    return found


def _entropy(run: RunFacts) -> dict[str, Any] | None:
    """Entropy of the modes, of tasks that can be done in several ways."""
    modes = run.modes.number
    name = next((name for name in _ENTROPIES if run.evaluated(name) is not None), None)
    if name is None or modes < 2:
        return None
    value, low, high = (run.evaluated(name + end) for end in ("", "_low", "_high"))
    contexts, episodes = run.evaluated("contexts"), run.evaluated("episodes")
    notes = [] if low is None or high is None else [f"95 % interval {low:.2f} to {high:.2f}"]
    distinct = run.evaluation.get("distinct_modes")
    notes += [] if distinct is None else [f"{distinct} of {modes} modes"]
    if run.successes and contexts and name == "mode_entropy":
        notes += [f"mean over contexts, {episodes / contexts:g} rollouts each"] if episodes else []
    elif run.successes:
        notes.append(f"a uniform choice averages {run.expected_entropy:.2f}, n = {run.successes}")
    return _tile(f"{_ENTROPIES[name]}, base {modes}", f"{value:.2f}", "; ".join(notes))


def _speed(run: RunFacts) -> dict[str, Any] | None:
    rate = run.evaluated("control_hz")
    if rate is None:
        return None
    parts = {"plan_ms": "ms per plan", "control_ms": "ms per control step"}
    notes = [f"{run.evaluated(key):.3g} {what}" for key, what in parts.items() if run.evaluated(key)]
    return _tile("control rate", f"{rate:.0f} Hz", ", ".join(notes))
