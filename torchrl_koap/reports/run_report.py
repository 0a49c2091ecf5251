# This source code is licensed under the MIT license found in the LICENSE file.
"""The one-page report of a run directory: plain HTML beside the pictures, nothing fetched from elsewhere."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import Any

from torchrl_koap.files import replacing_file
from torchrl_koap.reports.captions import CAPTIONS, caption
from torchrl_koap.reports.html import STYLE, definition, duration, interval_bar, number, table, tile
from torchrl_koap.reports.mode_plots import even_entropy
from torchrl_koap.reports.pictures import FOLDER, PICTURES, draw_pictures, task_names
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

ENTROPIES = {"mode_entropy": "mode entropy", "pooled_mode_entropy": "mode entropy, all contexts together"}
_BESIDE_LABELS = "demonstrations.png"
_SUMMARY_ELSEWHERE = ("labels",)
_EVAL_ELSEWHERE = ("episode", "command")
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
    for name in ("config", "summary", "eval"):
        files[name], note = _read(run_dir, f"{name}.json")
        notes += note
    config, summary, evaluation = files["config"], files["summary"], files["eval"]
    names = task_names(run_dir)
    sections = [
        _header(run_dir, config),
        "".join(f'<p class="warning">{escape(note)}</p>' for note in notes),
        _headline(run_dir, config, summary, evaluation, names["num_modes"]),
        _labels(run_dir, summary, problems),
        _pictures(run_dir, problems, names["task"]),
        _numbers(summary, evaluation),
        _reproduce(run_dir, config, evaluation),
    ]
    title = escape(_title(config))
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{STYLE}</style></head>\n'
        f"<body><main>\n{chr(10).join(section for section in sections if section)}\n</main></body></html>\n"
    )
    path = run_dir / "index.html"
    with replacing_file(path) as aside:
        aside.write_text(page, encoding="utf-8")
    return path


def _read(run_dir: Path, name: str) -> tuple[dict[str, Any], list[str]]:
    """Content of a JSON file, empty if it is absent or damaged, and what was wrong."""
    if not (run_dir / name).exists():
        return {}, []
    try:
        content = RunDirectory(run_dir).read_json(name)
    except (RunDirectoryError, OSError) as error:
        return {}, [str(error)]
    if not isinstance(content, dict):
        return {}, [f"{run_dir / name}: wanted a JSON object, got {type(content).__name__}"]
    return content, []


def _title(config: Mapping[str, Any]) -> str:
    method, task = config.get("method"), config.get("task")
    return f"{method} on {task}" if method and task else str(task or method or "run")


def _header(run_dir: Path, config: Mapping[str, Any]) -> str:
    shown = [f"{key.replace('_', ' ')} {config[key]}" for key in ("preset", "dataset", "seed") if _given(config, key)]
    line = " · ".join([str(run_dir), *shown])
    return f"<header><h1>{escape(_title(config))}</h1><p>{escape(line)}</p></header>"


def _headline(run_dir: Path, config: Mapping, summary: Mapping, evaluation: Mapping, num_modes: int) -> str:
    tiles = []
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
        tiles.append(tile(head, f"{number(evaluation[given]):.2f}", "; ".join(filter(None, notes))))
    errors, unit = _action_errors(summary)
    if errors:
        values = {key: number(value) for key, value in errors.items() if key != "analysis_labels_read"}
        values = {key: value for key, value in values.items() if value is not None}
        own = config.get("method") if config.get("method") in values else next(iter(values), None)
        if own is not None:
            others = [f"{key} {value:.2f} {unit}" for key, value in values.items() if key != own]
            read = number(errors.get("analysis_labels_read"))
            others += [f"n = {read:,.0f} unlabelled steps"] if read else []
            tiles.append(tile(f"action error, {own}", f"{values[own]:.2f} {unit}", ", ".join(others)))
    labels = summary.get("labels")
    if isinstance(labels, Mapping) and number(labels.get("labelled_transitions")) is not None:
        tiles.append(tile("action labels", f"{labels['labelled_transitions']:,.0f}", _share(labels)))
    control = number(evaluation.get("control_hz"))
    if control is not None:
        parts = [("plan_ms", "ms per plan"), ("control_ms", "ms per control step")]
        latency = [f"{number(evaluation[key]):.3g} {what}" for key, what in parts if number(evaluation.get(key))]
        tiles.append(tile("control rate", f"{control:.0f} Hz", ", ".join(latency)))
    seconds = summary.get("train_seconds")
    spent = {"": seconds} if not isinstance(seconds, Mapping) else seconds
    spent = {key: number(value) for key, value in spent.items() if number(value) is not None}
    if spent:
        each = ", ".join(f"{key} {duration(value)}" for key, value in spent.items() if key)
        whole = sum(value for key, value in spent.items() if key != "total")
        tiles.append(tile("training time", duration(whole), each))
    missing = ""
    if not evaluation:
        missing = f"<p>Not evaluated yet. {_hint('koap eval {run} --episodes 60 --seed 100', run_dir)}</p>"
    return f'<section><h2>Result</h2><div class="tiles">{"".join(tiles)}</div>{missing}</section>'


def _between(evaluation: Mapping[str, Any], name: str, form: str) -> str:
    """The interval of an entry in words, empty if it has none."""
    low, high = (number(evaluation.get(f"{name}_{end}")) for end in ("low", "high"))
    return "" if low is None or high is None else f"95 % interval {form.format(low)} to {form.format(high)}"


def _rate(evaluation: Mapping[str, Any], name: str, head: str, what: str) -> list[str]:
    """Tile of a share of the rollouts with its interval, if it was measured."""
    rate, episodes = number(evaluation.get(f"{name}_rate")), number(evaluation.get("episodes"))
    if rate is None:
        return []
    low, high = (number(evaluation.get(f"{name}_{end}")) for end in ("low", "high"))
    between, bar = "", ""
    if low is not None and high is not None:
        between, bar = f"95 % interval {100 * low:.1f} to {100 * high:.1f} %", interval_bar(rate, low, high)
    count = f"{round(rate * episodes)} of {episodes:g}{what}" if episodes else ""
    return [tile(head, f"{100 * rate:.1f} %", ", ".join(filter(None, (between, count))), bar)]


def _action_errors(summary: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
    """Errors of the predicted actions, empty if there are none, and their unit."""
    for unit in ("mm", "mrad"):
        if isinstance(summary.get(f"action_error_{unit}"), Mapping):
            return summary[f"action_error_{unit}"], unit
    return {}, ""


def _share(labels: Mapping[str, Any]) -> str:
    labelled, total = number(labels.get("labelled_transitions")), number(labels.get("total_transitions"))
    touched, trajectories = number(labels.get("trajectories_touched")), number(labels.get("total_trajectories"))
    parts = [f"{labelled / total:.2%} of {total:,.0f} transitions".replace("%", " %")] if total else []
    parts += [f"in {touched:g} of {trajectories:g} demonstrations"] if touched is not None and trajectories else []
    return ", ".join(parts)


def _labels(run_dir: Path, summary: Mapping[str, Any], problems: Mapping[str, str]) -> str:
    labels = summary.get("labels")
    if isinstance(labels, Mapping):
        text = "<p>What the training was allowed to read; everything else was hidden before it began.</p>"
        text += table(labels)
    else:
        text = f"<p>No account of the labels. {_hint('koap train --out {run}', run_dir)}</p>"
    read = number(_action_errors(summary)[0].get("analysis_labels_read"))
    if read:
        text += (
            f"<p><strong>Outside the budget, for analysis only:</strong> {read:,.0f} labels were read to measure the"
            " action error below. They trained nothing and selected nothing.</p>"
        )
    figure = _figure(run_dir, _BESIDE_LABELS, problems)
    return f'<section><h2>Labels</h2><div class="account"><div>{text}</div>{figure}</div></section>'


def _pictures(run_dir: Path, problems: Mapping[str, str], task: str | None) -> str:
    known = {picture.name: picture for picture in PICTURES}
    parts, missing = [], {}
    for name, (head, _) in CAPTIONS.items():
        figure = _figure(run_dir, name, problems, task)
        if figure and name != _BESIDE_LABELS:
            parts.append(figure)
        elif not figure and name not in problems and name in known and not (run_dir / known[name].source).exists():
            missing.setdefault(known[name].command, []).append(head)
        elif not figure and name == "plans.png" and name not in problems:
            parts.append(f'<p class="absent">{head}: not drawn, the rollouts hold no plans of positions.</p>')
    hints = [f"<li>{escape(', '.join(heads))}. {_hint(command, run_dir)}</li>" for command, heads in missing.items()]
    absent = f'<div class="absent"><p>Not drawn because the data are absent:</p><ul>{"".join(hints)}</ul></div>'
    return f"<section><h2>Pictures</h2>{''.join(parts)}{absent if hints else ''}</section>"


def _figure(run_dir: Path, name: str, problems: Mapping[str, str], task: str | None = None) -> str:
    source = f"{FOLDER}/{name}"
    if name in problems or not (run_dir / source).exists():
        return ""
    head, text = map(escape, caption(name, task))
    if name.endswith(".mp4"):
        media = f'<video src="{source}" controls loop muted playsinline aria-label="{head}"></video>'
    else:
        media = f'<a href="{source}"><img src="{source}" alt="{head}"></a>'
    if name.endswith((".gif", ".mp4")):
        return f'<figure class="beside">{media}<figcaption><h3>{head}</h3>{text}</figcaption></figure>'
    return f"<figure><h3>{head}</h3>{media}<figcaption>{text}</figcaption></figure>"


def _numbers(summary: Mapping[str, Any], evaluation: Mapping[str, Any]) -> str:
    columns = ""
    for head, source, elsewhere in (
        ("Evaluation", evaluation, _EVAL_ELSEWHERE),
        ("Training", summary, _SUMMARY_ELSEWHERE),
    ):
        shown = {key: value for key, value in source.items() if key not in elsewhere}
        if shown:
            columns += f"<div><h3>{head}</h3>{table(shown)}</div>"
    episodes = ""
    if evaluation.get("episode"):
        rows = definition("episode", evaluation["episode"])
        episodes = f"<details><summary>Every episode</summary>{rows}</details>"
    if not columns and not episodes:
        return ""
    return f'<section><h2>All numbers</h2><div class="account">{columns}</div>{episodes}</section>'


def _reproduce(run_dir: Path, config: Mapping[str, Any], evaluation: Mapping[str, Any]) -> str:
    commands = [_command(source["command"]) for source in (config, evaluation) if _given(source, "command")]
    if evaluation and not _given(evaluation, "command"):
        commands.append(_eval_command(run_dir, evaluation))
    text = f"<pre>{escape(chr(10).join(commands))}</pre>" if commands else ""
    if config and not _given(config, "command"):
        text += "<p>The configuration holds no command line; its options are below.</p>"
    if _given(config, "versions"):
        text += "<h3>Versions</h3>" + definition("versions", config["versions"])
    shown = {key: value for key, value in config.items() if key not in _CONFIG_ELSEWHERE}
    if shown:
        text += "<details><summary>Every option of the training</summary>" + table(shown) + "</details>"
    if not config:
        text += f"<p>No <code>config.json</code>. {_hint('koap train --out {run}', run_dir)}</p>"
    return f"<section><h2>Do it again</h2>{text}</section>"


def _command(command: Any) -> str:
    return shlex.join(map(str, command)) if isinstance(command, (list, tuple)) else str(command)


def _eval_command(run_dir: Path, evaluation: Mapping[str, Any]) -> str:
    words = ["koap", "eval", str(run_dir)]
    episode = evaluation.get("episode")
    first = episode[0] if isinstance(episode, list) and episode and isinstance(episode[0], Mapping) else {}
    options = {"episodes": evaluation.get("episodes"), "seed": evaluation.get("seed", first.get("seed"))}
    options |= {key: evaluation.get(key) for key in ("execution", "solver", "solver_steps")}
    for key, value in options.items():
        if value is not None:
            words += [f"--{key.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _hint(command: str, run_dir: Path) -> str:
    return f"Made by <code>{escape(command.format(run=shlex.quote(str(run_dir))))}</code>."


def _given(source: Mapping[str, Any], key: str) -> bool:
    return source.get(key) not in (None, "", [], {})
