# This source code is licensed under the MIT license found in the LICENSE file.
"""Going on with an interrupted run: its options, and the checks that nothing else is asked for now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl._utils import logger

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import changed_options, fill_in, read_config
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError, no_data

# with which a run may be resumed differently; with other threads sums are rounded differently. Demonstrations may lie
# elsewhere: their checksum says whether they are the same
FREE = frozenset({"dataset", "out", "run.threads", "run.resume", "run.plugins", "run.logger"})
_ONE_OF = ("fraction", "count", "episodes")


def begun_with(run: RunDirectory, asked: TrainConfig) -> TrainConfig:
    """Returns the options of a run, which may be new: of a resumed one what is not asked for otherwise is as it was."""
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
    """Refuses a folder that holds another run than what is to be trained, or was not asked to be resumed."""
    if not (run.path / "config.json").exists():
        run.refuse_data()
        names = ("planner.safetensors", "controller.safetensors", "checkpoints")
        if left := [name for name in names if (run.path / name).exists()]:
            raise RunDirectoryError(f"{run.path} holds {', '.join(left)} but no config.json; choose another --out")
        return
    if not config.run.resume:
        raise RunDirectoryError(f"{run.path} holds a run already; choose another --out, or --resume it (run.resume)")
    saved = read_config(run)
    # a folder that is gone was moved, probably together with this run: there is nothing to compare with
    source = saved.planner.source
    moved = {"planner.source"} if source is not None and not source.exists() else set()
    if changed := [name for name in changed_options(config, saved) if name not in FREE | moved]:
        raise RunDirectoryError(f"{run.path} was started with another {', '.join(changed)}; it cannot be resumed so")


def check_data(run: RunDirectory, content: Mapping[str, Any]) -> None:
    """Refuses to go on with other demonstrations, or another version of this package, than a run was begun with.

    Demonstrations are other ones, too, where the task that they hold says otherwise what the same numbers are.
    ``content`` is what ``config.json`` is to hold, ``data`` and ``versions`` included.
    """
    if not (run.path / "config.json").exists():
        return
    earlier = run.read_json("config.json")
    before, now = earlier.get("data"), content["data"]
    if before != now:
        steps = (before or {}).get("steps")
        sizes = f"{steps} steps then, {now['steps']} now" if steps != now["steps"] else "others"
        raise RunDirectoryError(
            f"{run.path} was started with other demonstrations than {content['dataset']} holds now ({sizes}); bring the"
            " earlier ones back, or choose another --out"
        )
    meant, means = earlier.get("task_definition") or {}, content.get("task_definition") or {}
    if changed := [name for name in means if meant.get(name, means[name]) != means[name]]:
        raise RunDirectoryError(
            f"{run.path} was started when {content['dataset']} said otherwise what its columns are"
            f" ({', '.join(changed)}); convert it again as it was, or choose another --out"
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
