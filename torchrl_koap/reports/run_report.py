# This source code is licensed under the MIT license found in the LICENSE file.
"""The one-page report of a run directory: collects the content of its template from the existing files."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_koap.files import option_words
from torchrl_koap.reports.advice import advice
from torchrl_koap.reports.html import write_page
from torchrl_koap.reports.pictures import EVAL, FOLDER, TRAIN, all_pictures, draw_pictures
from torchrl_koap.reports.rows import evaluation_rows, training_rows
from torchrl_koap.reports.run_facts import RunFacts, entry_at

_SIMULATED = ("rollouts.safetensors", "inspect.json")
_BESIDE_LABELS = "demonstrations.png"
_EVAL_ELSEWHERE = ("episode", "trajectory", "faults", "rates", "action_errors")
_ABOUT_ENV = ("env", "env_kwargs", "success_key", "num_envs")
_CONFIG_ELSEWHERE = ("versions", "command")


def write_report(folder: str | Path, *, draw: bool = True, animation: bool = True) -> Path:
    """Writes ``index.html`` into a run directory; sections whose files are absent name the command that makes them.

    Draws pictures first (``draw``; else existing ones are shown), with animations if ``animation``.
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
        tiles=evaluation_rows(run),
        evaluated=bool(evaluation),
        commands={name: _filled(command, run) for name, command in commands.items()},
        advice=[replace(item, command=_filled(item.command, run)) for item in advice(run)],
        training=training_rows(run),
        labels_read=run.evaluation.get("labels_read_outside_budget"),
        label_figure=next((item for item in figures if item["name"] == _BESIDE_LABELS), None),
        figures=[item for item in figures if item["name"] != _BESIDE_LABELS],
        missing=missing,
        numbers=[
            (head, shown)
            for head, source, elsewhere in (
                ("Evaluation", evaluation, _EVAL_ELSEWHERE),
                ("Training", summary, ("command_ranges",)),
            )
            if (shown := {key: value for key, value in source.items() if key not in elsewhere})
        ],
        episodes=evaluation.get("episode") or evaluation.get("trajectory"),
        again=[config.get("command")] * _given(config, "command") + [_eval_command(run)] * bool(evaluation),
        config=config,
        options={key: value for key, value in config.items() if key not in _CONFIG_ELSEWHERE},
    )


def _subtitle(run: RunFacts) -> str:
    sections = {"preset": run.config.get("controller"), "dataset": run.config, "seed": run.config.get("run")}
    shown = [f"{name} {section[name]}" for name, section in sections.items() if section and _given(section, name)]
    return " · ".join([str(run.folder), *shown])


def _figures(run: RunFacts, problems: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, list[str]]]:
    """Returns the figures to show, and for each command the titles of the pictures whose source it would write."""
    nothing = {  # reasons why no command would write a source
        "actions.safetensors": entry_at(run.action_errors, "outside_budget", "note"),
        "metrics.csv": "the training logged no loss" if run.summary else None,
    }
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
        elif not source and nothing.get(item.source):
            figures.append(figure | {"empty": nothing[item.source]})
        elif not source:
            missing.setdefault(_filled(item.made_by, run), []).append(item.title)
        elif item.empty:
            figures.append(figure | {"empty": item.empty})
    return figures, missing


def _eval_command(run: RunFacts) -> str:
    evaluation = run.evaluation
    options = {"seed": evaluation.get("seed")}
    if "episode" in evaluation:  # rolled out, not evaluated on recorded data
        options = {"episodes": evaluation["episodes"], "seed": evaluation["episode"][0]["seed"]}
    options |= evaluation.get("execution", {}) | {key: evaluation.get(key) for key in _ABOUT_ENV}
    return shlex.join(["koap", "eval", str(run.folder), *option_words(options)])


def _filled(command: str, run: RunFacts) -> str:
    """Fills in a command for this run; rollouts use the environment of the last ones."""
    places = {"run": run.folder, "data": run.config.get("dataset")}
    line = command.format(**{name: shlex.quote(str(place)) for name, place in places.items()})
    rolls_out = "--episodes" in command or command.startswith("koap inspect")
    words = option_words({key: run.evaluation.get(key) for key in _ABOUT_ENV}) if rolls_out else ()
    return " ".join([line, *map(shlex.quote, words)])


def _given(source: Mapping[str, Any], key: str) -> bool:
    return source.get(key) not in (None, "", [], {})
