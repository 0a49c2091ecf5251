# This source code is licensed under the MIT license found in the LICENSE file.
"""Going on with an interrupted run: its options, and the check that nothing else is asked for now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from torchrl._utils import logger

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError

# with which a run may be resumed differently; with other threads sums are rounded differently
FREE = frozenset(
    {"out", "threads", "checkpoint_every", "resume", "force_data", "plugins", "command", "versions", "data"}
)
_EVERY_TIME = ("resume", "force_data")  # asked for anew or not at all


def started_with(run: RunDirectory, config: TrainConfig) -> TrainConfig:
    """The options of a resumed run: what is not asked for otherwise is as it was.

    Args:
        run (RunDirectory): the run, which may be new.
        config (TrainConfig): what is asked for now.
    """
    if not (config.resume and (run.path / "config.json").exists()):
        return config
    earlier = run.read_json("config.json")
    left = [field.name for field in fields(config) if getattr(config, field.name) == field.default]
    left = [name for name in left if name not in _EVERY_TIME]
    kept = {name: earlier[name] for name in left if name in earlier}
    kept = {name: tuple(value) if isinstance(value, list) else value for name, value in kept.items()}
    if kept.get("planner_from") is not None:
        kept["planner_from"] = Path(kept["planner_from"])
    return replace(config, **kept)


def begun_by(run: RunDirectory, command: str | None) -> str | None:
    """The command that a run was begun with, which says what it is; the one that goes on with it leaves options out.

    Args:
        run (RunDirectory): the run, which may be new.
        command (str, optional): how the training was called now, where it was called from a shell.
    """
    earlier = run.read_json("config.json") if (run.path / "config.json").exists() else {}
    return earlier.get("command") or command


def check_resume(run: RunDirectory, content: Mapping[str, Any], *, resume: bool) -> None:
    """Refuses a folder that holds another run, or one that was not asked to be resumed.

    Args:
        run (RunDirectory): the folder.
        content (mapping): what ``config.json`` is to hold (:func:`~torchrl_koap.training.provenance.to_json`).

    Keyword Args:
        resume (bool): going on is asked for.

    Raises:
        RunDirectoryError: naming what differs.
    """
    if not (run.path / "config.json").exists():
        left = [name for name in ("planner.safetensors", "controller.safetensors", "checkpoints") if _is_in(run, name)]
        if left:
            raise RunDirectoryError(f"{run.path} holds {', '.join(left)} but no config.json; choose another --out")
        return
    if not resume:
        raise RunDirectoryError(f"{run.path} holds a run already; choose another --out, or --resume it")
    earlier = run.read_json("config.json")
    # a folder that is gone was moved, probably together with this run: there is nothing to compare with
    paths = {name: earlier.get(name) for name in ("dataset", "planner_from")}
    moved = {name for name, path in paths.items() if path not in (None, "scripted") and not Path(path).exists()}
    fixed = [key for key in content if key not in FREE | moved]
    changed = [key for key in fixed if (content[key] or None) != (earlier.get(key) or None)]  # off, or not there yet
    if changed:
        raise RunDirectoryError(f"{run.path} was started with another {', '.join(changed)}; it cannot be resumed so")


def _is_in(run: RunDirectory, name: str) -> bool:
    return (run.path / name).exists()


def check_data(run: RunDirectory, content: Mapping[str, Any], *, force: bool = False) -> None:
    """Refuses to go on with other demonstrations, or another version of this package, than a run was begun with.

    The weights would be neither those of the one nor of the other. Runs of earlier versions kept nothing to compare.

    Args:
        run (RunDirectory): the folder.
        content (mapping): what ``config.json`` is to hold, ``data`` included
            (:func:`~torchrl_koap.training.provenance.fingerprint`).

    Keyword Args:
        force (bool): go on all the same.

    Raises:
        RunDirectoryError: naming what differs.
    """
    if force or not (run.path / "config.json").exists():
        return
    earlier = run.read_json("config.json")
    before, now = earlier.get("data"), content["data"]
    if before not in (None, now):
        sizes = (
            f"{before.get('steps')} steps then, {now['steps']} now" if before.get("steps") != now["steps"] else "others"
        )
        raise RunDirectoryError(
            f"{run.path} was started with other demonstrations than {content['dataset']} holds now ({sizes}); bring the"
            " earlier ones back, choose another --out, or insist with --force-data"
        )
    then, here = (versions.get("versions") or {} for versions in (earlier, content))
    if then.get("torchrl_koap", here["torchrl_koap"]) != here["torchrl_koap"]:
        raise RunDirectoryError(
            f"{run.path} was started with torchrl_koap {then['torchrl_koap']}, this is {here['torchrl_koap']}; choose"
            " another --out, or insist with --force-data"
        )
    others = [f"{name} {then[name]} (now {here[name]})" for name in here if then.get(name, here[name]) != here[name]]
    if others:
        logger.warning("%s was started with %s: the last bits of its weights may differ", run.path, ", ".join(others))
