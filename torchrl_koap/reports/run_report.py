# This source code is licensed under the MIT license found in the LICENSE file.
"""The one-page report of a run directory: what a template needs, gathered from the files that are there."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchrl_koap.reports.advice import Numbers, advice
from torchrl_koap.reports.html import bar, duration, number, write_page
from torchrl_koap.reports.mode_plots import even_entropy
from torchrl_koap.reports.pictures import FOLDER, all_pictures, draw_pictures, run_facts
from torchrl_koap.reports.style import thousandths
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError

ENTROPIES = {"mode_entropy": "mode entropy", "pooled_mode_entropy": "mode entropy, all contexts together"}
_SIMULATED = ("rollouts.safetensors", "inspect.json")
_BESIDE_LABELS = "demonstrations.png"
_COMMANDS = {"train": "koap train --out {run}", "eval": "koap eval {run} --episodes 60 --seed 100"}
_OFFLINE_COMMANDS = _COMMANDS | {"eval": "koap eval {run}"}
_PLAN_BASELINES = ("standing_still", "constant_velocity")
_SUMMARY_ELSEWHERE = ("labels",)
_EVAL_ELSEWHERE = ("episode", "command", "trajectory", "faults")
_CONFIG_ELSEWHERE = ("versions", "command")


def write_report(
    run_dir: str | Path,
    *,
    draw: bool = True,
    animation: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Writes ``index.html`` into a run directory; sections whose files are absent say which command makes them.

    Args:
        run_dir (str or Path): the run directory. Read are ``config.json``, ``summary.json``, ``eval.json`` and the
            files behind the pictures, all optional.
        draw (bool): draw the pictures first. Otherwise those already there are shown.
        animation (bool): draw the moving picture too.
        progress (callable, optional): see :func:`~torchrl_koap.reports.pictures.draw_pictures`.

    Returns:
        Path: the page.

    Raises:
        FileNotFoundError: if there is no such directory.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_koap.reports.run_report import write_report
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "eval.json").write_text('{"success_rate": 0.5, "episodes": 2}')
        ...     "50.0 %" in write_report(folder).read_text()
        True
    """
    run_dir = Path(run_dir)
    if not run_dir.is_dir():
        raise FileNotFoundError(f"there is no run directory {str(run_dir)!r}")
    problems = draw_pictures(run_dir, animation=animation, progress=progress) if draw else {}
    files, notes = {}, list(problems.values())
    for name in ("config", "summary", "eval", "inspect"):
        files[name], note = _read(run_dir, f"{name}.json")
        notes += note
    config, summary, evaluation = files["config"], files["summary"], files["eval"]
    facts = run_facts(run_dir)
    offline = facts["columns"] is not None
    notes += evaluation.get("faults") or []
    note = _action_errors(summary)[0].get("note")  # why the training left no actions to draw
    reasons = {"actions.safetensors": note} if isinstance(note, str) else {}
    figures, missing = _figures(run_dir, problems, facts["task"], reasons, offline=offline)
    return write_page(
        "run.html",
        run_dir / "index.html",
        title=_title(config),
        subtitle=_subtitle(run_dir, config),
        notes=notes,
        tiles=_tiles(config, summary, evaluation, facts["num_modes"]),
        evaluated=bool(evaluation),
        commands={
            name: _filled(command, run_dir) for name, command in (_OFFLINE_COMMANDS if offline else _COMMANDS).items()
        },
        advice=_advice(run_dir, files, facts),
        labels=summary.get("labels"),
        labels_read=number(_action_errors(summary)[0].get("analysis_labels_read")),
        label_figure=next((item for item in figures if item.get("name") == _BESIDE_LABELS), None),
        figures=[item for item in figures if item["name"] != _BESIDE_LABELS],
        missing=missing,
        numbers=_numbers(summary, evaluation),
        episodes=evaluation.get("episode") or evaluation.get("trajectory"),
        again=_commands(run_dir, config, evaluation),
        configured=bool(config),
        has_command=_given(config, "command"),
        versions=config.get("versions"),
        options={key: value for key, value in config.items() if key not in _CONFIG_ELSEWHERE},
    )


def _advice(run_dir: Path, files: Mapping[str, Mapping[str, Any]], facts: Mapping[str, Any]) -> list[dict[str, str]]:
    """What the numbers say to try next, command lines filled in."""
    evaluation = files["eval"]
    rate, episodes = number(evaluation.get("success_rate")), number(evaluation.get("episodes"))
    successes = round(rate * episodes) if rate and episodes else 0
    found = advice(
        Numbers(
            config={**files["config"], "control_hz": facts["control_hz"]},
            summary=files["summary"],
            evaluation=evaluation,
            inspection=files["inspect"],
            even_entropy=even_entropy(successes, facts["num_modes"]) if successes else None,
        )
    )
    return [
        {"finding": item.finding, "proposal": item.proposal, "command": _filled(item.command, run_dir)}
        for item in found
    ]


def _read(run_dir: Path, name: str) -> tuple[dict[str, Any], list[str]]:
    """Content of a JSON file, empty if it is absent or damaged, and what was wrong."""
    if not (run_dir / name).exists():
        return {}, []
    try:
        content: Any = RunDirectory(run_dir).read_json(name)
    except (RunDirectoryError, OSError) as error:
        return {}, [str(error)]
    if not isinstance(content, dict):
        return {}, [f"{run_dir / name}: wanted a JSON object, got {type(content).__name__}"]
    return content, []


def _title(config: Mapping[str, Any]) -> str:
    method, task = config.get("method"), config.get("task")
    return f"{method} on {task}" if method and task else str(task or method or "run")


def _subtitle(run_dir: Path, config: Mapping[str, Any]) -> str:
    shown = [f"{key.replace('_', ' ')} {config[key]}" for key in ("preset", "dataset", "seed") if _given(config, key)]
    return " · ".join([str(run_dir), *shown])


def _tile(name: str, value: str, note: str, bar: tuple[float, float, float] | None = None) -> dict[str, Any]:
    return {"name": name, "value": value, "note": note, "bar": bar}


def _tiles(config: Mapping, summary: Mapping, evaluation: Mapping, num_modes: int) -> list[dict[str, Any]]:
    """The headline numbers, those that there are."""
    tiles = _offline_tiles(evaluation)
    rate, episodes = number(evaluation.get("success_rate")), number(evaluation.get("episodes"))
    contexts = number(evaluation.get("contexts"))
    among = f" in {contexts:g} contexts" if contexts else ""
    tiles += _rate(evaluation, "success", "success", f" rollouts{among}")
    for count, what in ((1, "one box"), (2, "two boxes"), (3, "three boxes")):
        tiles += _rate(evaluation, f"stacked_{count}", f"{what} stacked", " rollouts")
    given = next((key for key in ENTROPIES if number(evaluation.get(key)) is not None), None)
    if given is not None:
        seen = f"{evaluation['distinct_modes']} of {num_modes} modes" if _given(evaluation, "distinct_modes") else ""
        successes = round(rate * episodes) if rate is not None and episodes else 0
        if contexts and given == "mode_entropy":
            even = f"mean over contexts, {episodes / contexts:g} rollouts each" if episodes else ""
        else:
            even = f"an even choice averages {even_entropy(successes, num_modes):.2f}, n = {successes}"
        notes = (_between(evaluation, given, "{:.2f}"), seen, even if successes else "")
        head = f"{ENTROPIES[given]}, base {num_modes}"
        tiles.append(_tile(head, f"{number(evaluation[given]):.2f}", "; ".join(filter(None, notes))))
    errors, unit = _action_errors(summary)
    if errors:
        values = {key: number(value) for key, value in errors.items() if key != "analysis_labels_read"}
        values = {key: value for key, value in values.items() if value is not None}
        own = config.get("method") if config.get("method") in values else next(iter(values), None)
        if own is not None:
            others = [f"{key} {value:.2f} {unit}" for key, value in values.items() if key != own]
            read = number(errors.get("analysis_labels_read"))
            others += [f"n = {read:,.0f} unlabelled steps"] if read else []
            tiles.append(_tile(f"action error, {own}", f"{values[own]:.2f} {unit}", ", ".join(others)))
    labels = summary.get("labels")
    if isinstance(labels, Mapping) and number(labels.get("labelled_transitions")) is not None:
        tiles.append(_tile("action labels", f"{labels['labelled_transitions']:,.0f}", _share(labels)))
    control = number(evaluation.get("control_hz"))
    if control is not None:
        parts = [("plan_ms", "ms per plan"), ("control_ms", "ms per control step")]
        latency = [f"{number(evaluation[key]):.3g} {what}" for key, what in parts if number(evaluation.get(key))]
        tiles.append(_tile("control rate", f"{control:.0f} Hz", ", ".join(latency)))
    seconds = summary.get("train_seconds")
    spent = {"": seconds} if not isinstance(seconds, Mapping) else seconds
    spent = {key: number(value) for key, value in spent.items() if number(value) is not None}
    if spent:
        each = ", ".join(f"{key} {duration(value)}" for key, value in spent.items() if key)
        whole = sum(value for key, value in spent.items() if key != "total")
        tiles.append(_tile("training time", duration(whole), each))
    return tiles


def _offline_tiles(evaluation: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Errors of plans and actions, of an evaluation without an environment."""
    tiles = []
    for row in evaluation.get("plan_errors", {}).get("unit", ()):
        shown, factor = thousandths(row["unit"])
        values = {name: factor * row[name]["energy_score"]["overall"] for name in ("planner", *_PLAN_BASELINES)}
        note = ", ".join(f"{name.replace('_', ' ')} {values[name]:.3g}" for name in _PLAN_BASELINES)
        head = f"plan error, energy score, {len(row['columns'])} columns"
        tiles.append(_tile(head, f"{values['planner']:.3g} {shown}".rstrip(), note))
    errors = evaluation.get("action_errors", {})
    split = evaluation.get("action_errors_on")
    for row in errors.get(split, {}).get("unit", ()) if split else ():
        shown, factor = thousandths(row["unit"])
        others = [f"{name.replace('_', ' ')} {factor * row[name]:.3g}" for name in ("ridge", "mean_action")]
        others.append(f"n = {errors[split]['labels']:,} labels, {split.replace('_', ' ')}")
        head = f"action error, {len(row['columns'])} columns"
        tiles.append(_tile(head, f"{factor * row['controller']:.3g} {shown}".rstrip(), ", ".join(others)))
    return tiles


def _between(evaluation: Mapping[str, Any], name: str, form: str) -> str:
    """The interval of an entry in words, empty if it has none."""
    low, high = (number(evaluation.get(f"{name}_{end}")) for end in ("low", "high"))
    return "" if low is None or high is None else f"95 % interval {form.format(low)} to {form.format(high)}"


def _rate(evaluation: Mapping[str, Any], name: str, head: str, what: str) -> list[dict[str, Any]]:
    """Tile of a share of the rollouts with its interval, if it was measured."""
    rate, episodes = number(evaluation.get(f"{name}_rate")), number(evaluation.get("episodes"))
    if rate is None:
        return []
    low, high = (number(evaluation.get(f"{name}_{end}")) for end in ("low", "high"))
    between, drawn = "", None
    if low is not None and high is not None:
        between, drawn = f"95 % interval {100 * low:.1f} to {100 * high:.1f} %", bar(rate, low, high)
    count = f"{round(rate * episodes)} of {episodes:g}{what}" if episodes else ""
    return [_tile(head, f"{100 * rate:.1f} %", ", ".join(filter(None, (between, count))), drawn)]


def _action_errors(summary: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """Errors of the predicted actions, empty if there are none, and their unit."""
    for name, errors in summary.items():
        if name.startswith("action_error") and isinstance(errors, Mapping):
            return errors, name.removeprefix("action_error").removeprefix("_")
    return {}, ""


def _share(labels: Mapping[str, Any]) -> str:
    labelled, total = number(labels.get("labelled_transitions")), number(labels.get("total_transitions"))
    touched, trajectories = number(labels.get("trajectories_touched")), number(labels.get("total_trajectories"))
    parts = [f"{labelled / total:.2%} of {total:,.0f} transitions".replace("%", " %")] if total else []
    parts += [f"in {touched:g} of {trajectories:g} demonstrations"] if touched is not None and trajectories else []
    return ", ".join(parts)


def _figures(
    run_dir: Path, problems: Mapping[str, str], task: str | None, reasons: Mapping[str, str], *, offline: bool
) -> tuple[list[dict[str, Any]], dict[str, list[str]]]:
    """What is to be shown, and for each command the titles of the pictures whose source it would leave."""
    figures: list[dict[str, Any]] = []
    missing: dict[str, list[str]] = {}
    for name, item in all_pictures().items():
        file = next((n for n in (name, Path(name).stem + ".mp4") if (run_dir / FOLDER / n).exists()), None)
        if name in problems:
            continue
        figure: dict[str, Any] = {"name": name, "title": item.title, "caption": item.caption_for(task), "empty": ""}
        if file is not None:
            moving = file.endswith((".gif", ".mp4"))
            figures.append(figure | {"source": f"{FOLDER}/{file}", "beside": moving})
        elif (item.source in _SIMULATED) if offline else item.recorded:
            continue  # no command makes it for this task
        elif not (run_dir / item.source).exists() and item.source in reasons:
            figures.append(figure | {"empty": reasons[item.source]})  # no command would make it
        elif not (run_dir / item.source).exists():
            missing.setdefault(_filled(item.command, run_dir), []).append(item.title)
        elif item.empty:
            figures.append(figure | {"empty": item.empty})
    return figures, missing


def _numbers(summary: Mapping[str, Any], evaluation: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Everything else in the files, under a heading each."""
    return [
        (head, shown)
        for head, source, elsewhere in (
            ("Evaluation", evaluation, _EVAL_ELSEWHERE),
            ("Training", summary, _SUMMARY_ELSEWHERE),
        )
        if (shown := {key: value for key, value in source.items() if key not in elsewhere})
    ]


def _commands(run_dir: Path, config: Mapping[str, Any], evaluation: Mapping[str, Any]) -> list[str]:
    """Command lines that train and evaluate the run again."""
    commands = [_command(source["command"]) for source in (config, evaluation) if _given(source, "command")]
    if evaluation and not _given(evaluation, "command"):
        commands.append(_eval_command(run_dir, evaluation))
    return commands


def _command(command: Any) -> str:
    return shlex.join(map(str, command)) if isinstance(command, (list, tuple)) else str(command)


def _eval_command(run_dir: Path, evaluation: Mapping[str, Any]) -> str:
    words = ["koap", "eval", str(run_dir)]
    if evaluation.get("kind") == "offline":
        evaluation = {name: evaluation.get(name) for name in ("seed",)}
    episode = evaluation.get("episode")
    first = episode[0] if isinstance(episode, list) and episode and isinstance(episode[0], Mapping) else {}
    options = {"episodes": evaluation.get("episodes"), "seed": evaluation.get("seed", first.get("seed"))}
    options |= {key: evaluation.get(key) for key in ("execution", "env", "success_key")}
    options["controller"] = "oracle" if evaluation.get("controller") == "oracle" else None
    for key, value in options.items():
        if value is not None:
            words += [f"--{key.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _filled(command: str, run_dir: Path) -> str:
    return command.format(run=shlex.quote(str(run_dir)))


def _given(source: Mapping[str, Any], key: str) -> bool:
    return source.get(key) not in (None, "", [], {})
