# This source code is licensed under the MIT license found in the LICENSE file.
"""Resumes an interrupted run: restores its options, and checks that they, data and version are unchanged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl._utils import logger

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import changed_options, fill_in, read_config
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError, no_data

# options that may differ in a resumed run. Other numbers of threads round sums differently. The data set may have
# moved: a checksum identifies it
FREE = frozenset({"dataset", "out", "run.threads", "run.resume", "run.plugins", "run.logger"})
_ONE_OF = ("fraction", "count", "episodes")


def begun_with(run: RunDirectory, asked: TrainConfig) -> TrainConfig:
    """Returns the options of a new or resumed run; a resumed one keeps its earlier options unless others are given."""
    begun = (run.path / "config.json").exists()
    if asked.run.resume and asked.dataset is None and not begun:
        raise RunDirectoryError(f"{run.path} holds no run to resume: it has no config.json")
    if not (asked.run.resume and begun):
        return asked
    saved = read_config(run)
    if asked.dataset is None and saved.dataset is not None and not Path(saved.dataset).exists():
        raise no_data(saved.dataset, run.path)
    if any(vars(asked.labels)[name] for name in _ONE_OF):
        saved = replace(saved, labels=replace(saved.labels, fraction=None, count=None, episodes=()))
    return fill_in(asked, saved)


def check_resume(run: RunDirectory, config: TrainConfig) -> None:
    """Raises a RunDirectoryError if the folder holds a run and ``resume`` is not set, or its options differ."""
    if not (run.path / "config.json").exists():
        run.refuse_data()
        names = ("planner.safetensors", "controller.safetensors", "checkpoints")
        if left := [name for name in names if (run.path / name).exists()]:
            raise RunDirectoryError(f"{run.path} holds {', '.join(left)} but no config.json; choose another --out")
        return
    if not config.run.resume:
        raise RunDirectoryError(f"{run.path} holds a run already; choose another --out, or --resume it (run.resume)")
    saved = read_config(run)
    # a missing folder was probably moved together with this run: do not compare it
    source = saved.planner.source
    moved = {"planner.source"} if source is not None and not source.exists() else set()
    if changed := [name for name in changed_options(config, saved) if name not in FREE | moved]:
        raise RunDirectoryError(f"{run.path} was started with another {', '.join(changed)}: it cannot be resumed")


def check_data(run: RunDirectory, content: Mapping[str, Any]) -> None:
    """Raises a RunDirectoryError if demonstrations or version of this package differ from those a run started with.

    Demonstrations also differ if their task describes the same columns differently. ``content`` is the future content
    of ``config.json``, ``data`` and ``versions`` included.
    """
    if not (run.path / "config.json").exists():
        return
    earlier = run.read_json("config.json")
    if earlier.get("planner_only") and not content.get("planner_only"):
        raise RunDirectoryError(
            f"{run.path} holds a planner for other runs (planner.source), not a policy; choose another --out"
        )
    before, now = earlier.get("data"), content["data"]
    if before != now:
        steps = (before or {}).get("steps")
        sizes = f"{steps} steps then, {now['steps']} now" if steps != now["steps"] else "others"
        raise RunDirectoryError(
            f"{run.path} was started with other demonstrations than {content['dataset']} holds now ({sizes}); bring the"
            " earlier ones back, or choose another --out"
        )
    was, task = earlier.get("task_definition") or {}, content.get("task_definition") or {}
    if changed := [name for name in task if was.get(name, task[name]) != task[name]]:
        raise RunDirectoryError(
            f"{run.path} was started when {content['dataset']} described its columns differently"
            f" ({', '.join(changed)}); convert it again as before, or choose another --out"
        )
    then, here = earlier.get("versions") or {}, content["versions"]
    if then.get("torchrl_koap", here["torchrl_koap"]) != here["torchrl_koap"]:
        raise RunDirectoryError(
            f"{run.path} was started with torchrl_koap {then['torchrl_koap']}, this is {here['torchrl_koap']}; choose"
            " another --out"
        )
    others = [f"{name} {then[name]} (now {here[name]})" for name in here if then.get(name, here[name]) != here[name]]
    if others:
        logger.warning("%s was started with %s: its results may differ from a whole run's", run.path, ", ".join(others))
