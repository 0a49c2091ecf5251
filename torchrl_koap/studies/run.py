# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs the missing cells of a study, which may be interrupted at any moment, and writes its table and report."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import flatten_trajectories, open_dataset
from torchrl_koap.data.label_budget import subsample_trajectories
from torchrl_koap.runs.config import given_options
from torchrl_koap.runs.config_files import changed_options, from_json, to_json, versions
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.runs.resume import check_data
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError, write_csv
from torchrl_koap.studies.cells import FOUND, Cell, Result, cell_row, prepare_cell, read_result, run_cell
from torchrl_koap.studies.launchers import Job, Machines, launch
from torchrl_koap.studies.report import write_study_report
from torchrl_koap.studies.study import Study, check_study, complete, union
from torchrl_koap.studies.table import CELL_COLUMNS, STATUSES
from torchrl_koap.tasks import Task
from torchrl_koap.training.datasets import fingerprint

_FILE = "study.json"
# options to which a later call may add; all others must stay the same
_LISTS = ("tasks", "datasets", "planners", "methods", "labels", "levels", "demonstrations")
_MAY_CHANGE = (*_LISTS, "seeds", "out", "run.plugins")


@dataclass(frozen=True)
class StudyResult:
    """Results of a study."""

    rows: list[dict[str, Any]]  # cells as in cells.csv
    counts: Mapping[str, int]  # numbers of cells that are done, failed and missing
    report: Path  # the page


def run_study(study: Study, machines: Machines | None = None) -> StudyResult:
    """Runs the missing cells of a study and writes its report; ``koap curve`` calls this.

    A script must call it under ``if __name__ == "__main__":``, because workers import the script.

    Args:
        study (Study): what to compare, and where to write it.
        machines (Machines, optional): where the cells run.

    Returns:
        StudyResult: its cells, the numbers of cells that are done, failed and missing, and the path of the report.

    Raises:
        ValueError: before any work, for unknown names, and shares that are out of range or select nothing.
        RunDirectoryError: if the folder holds something else, a study with other settings or demonstrations, or one
            on which another process works.
        PluginError: if a plugin cannot be imported.

    Examples:
        >>> from torchrl_koap import Study, run_study
        >>> study = Study(out="study", methods=("koap", "linear"), labels=(0.01, 0.1), seeds=2)
        >>> run_study(study).counts["done"]  # doctest: +SKIP
        8
        >>> run_study(Study(out="study", methods=("kaop",)))  # refused before anything is done
        Traceback (most recent call last):
        ...
        ValueError: unknown method 'kaop'; did you mean 'koap'?
    """
    before = _read_study(given_options(study, Study).out)
    study = complete(study, () if before is None else before.run.plugins)
    cells, root = check_study(study), RunDirectory(study.out)
    _check_folder(study)
    facts = {}
    for name in study.tasks:
        data = _first_look(study, study.task(name))
        _check_labels(study, cells, name, data)
        given = study.given_dataset(name)
        facts[name] = {"dataset": given, "data": given and fingerprint(data), "versions": versions()}
        facts[name]["task_definition"] = given and study.task(name).definition()
        check_data(_begun(study, name), facts[name])
    with root.locked("koap curve", "lock"):
        _check_folder(study)  # another process may have finished here since the first check
        for name in study.tasks:
            _record(study, cells, name)
        whole = _together(study)
        root.write_json(_FILE, to_json(replace(whole, out=Path())))
        for name, content in facts.items():
            if not (_begun(study, name).path / "config.json").exists():
                _begun(study, name).write_json("config.json", content)
        asked = set(cells)  # the order of all cells gives a method its place and colour in every call
        shown = [cell for cell in whole.cells() if cell in asked or _was_begun(study.out / cell.folder)]
        failed, unit = _failed_before(study.out), study.label_unit
        results = {cell: cell_row(study.out, cell, label_unit=unit, reason=failed.get(cell.folder)) for cell in shown}
        _work(study, cells, results, machines or Machines())
        rows, tasks = _write_rows(study, results), whole.tasks
        outcomes = {row["run"]: found for row, found in results.values() if found}
        title = f"Label efficiency on {tasks[0] if len(tasks) == 1 else f'{len(tasks)} tasks'}"
        report = write_study_report(study.out, rows, outcomes, title=title, options=_given(to_json(whole)))
    return StudyResult(rows, {status: sum(row["status"] == status for row in rows) for status in STATUSES}, report)


def _begun(study: Study, task: str) -> RunDirectory:
    """Returns the folder that records the demonstrations and package versions that a task's cells started with."""
    return RunDirectory(study.out / "begun_with" / task)


def _read_study(folder: Path) -> Study | None:
    """Reads the request of an earlier call in a folder, None if there was none."""
    run = RunDirectory(folder)
    if not (run.path / _FILE).exists():
        return None
    return from_json(Study, run.read_json(_FILE), run.path / _FILE)


def _together(study: Study) -> Study:
    """Returns the union of a complete study and the requests of earlier calls in its folder."""
    earlier = _read_study(study.out)
    if earlier is None:
        return study
    lists: dict[str, Any] = {name: union(vars(earlier)[name], vars(study)[name]) for name in _LISTS}
    others = [text for text in earlier.datasets if text.partition("=")[0] not in study.tasks]
    lists["datasets"] = union(others, study.datasets)  # present folders: a data set may have moved
    return replace(study, **lists, seeds=max(study.seeds, earlier.seeds))


def _check_folder(study: Study) -> None:
    """Raises a RunDirectoryError if the folder holds something else, or a study with other settings, and names them."""
    path, earlier = study.out, _read_study(study.out)
    if earlier is None:
        # a study that is killed before it writes its options leaves these
        own = ("lock", "demonstrations", f".{_FILE}.")
        if path.exists() and not all(entry.name.startswith(own) for entry in path.iterdir()):
            raise RunDirectoryError(f"{path} is not empty and not a folder of `koap curve`; choose another --out")
        return
    changed = changed_options(earlier, study)
    different = [f"{name} ({attrgetter(name)(earlier)})" for name in changed if name not in _MAY_CHANGE]
    both = {*earlier.tasks} & {*study.tasks}
    # a checksum, not the path, decides whether a named data set is the same
    if any((earlier.given_dataset(task) is None) != (study.given_dataset(task) is None) for task in both):
        different.append(f"datasets ({', '.join(earlier.datasets)})")
    if any(earlier.given_planner(task) != study.given_planner(task) for task in both):
        different.append(f"planners ({', '.join(earlier.planners)})")
    if different:
        raise RunDirectoryError(f"{path} holds a study with another {', '.join(different)}; choose another --out")


def _was_begun(folder: Path) -> bool:
    # a cell that was run by hand has no log; a file in place of the folder made the cell fail
    return (folder / "log.txt").exists() or (folder / FOUND).exists() or folder.is_file()


def _failed_before(folder: Path) -> dict[str, str]:
    """Returns why cells failed in the last call, by their folder."""
    try:
        with (folder / "cells.csv").open(newline="", encoding="utf-8") as file:
            return {row.get("run"): row.get("reason") for row in csv.DictReader(file) if row.get("status") == "failed"}
    except (FileNotFoundError, UnicodeDecodeError, csv.Error):  # it is written again
        return {}


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the options of all sections that are neither None nor empty."""
    known = {name: _given(value) if isinstance(value, Mapping) else value for name, value in options.items()}
    return {name: value for name, value in known.items() if value not in (None, [], {})}


def _first_look(study: Study, task: Task) -> TensorDictBase | None:
    """Returns recorded demonstrations, else dummy ones of the future number; None if their lengths matter."""
    if study.has_data(task.name):
        return open_dataset(study.dataset_folder(task.name), task=task)[0]
    if task.env is None:
        raise ValueError(f"task {task.name!r} has no environment to record demonstrations in: give --datasets")
    if study.label_unit != "trajectory":
        return None
    number = study.record or task.defaults.demonstrations
    return flatten_trajectories([torch.zeros(2, 1)] * number, [torch.zeros(1, 1)] * number)


def _record(study: Study, cells: Sequence[Cell], name: str) -> None:
    folder, task = study.dataset_folder(name), study.task(name)
    if study.has_data(name):
        return
    from torchrl_koap.envs.experts.demonstrations import record_to_folder  # needs a simulator

    episodes = study.record or task.defaults.demonstrations
    with progress_bar(episodes, "demonstrations", unit="episode") as bar:
        record_to_folder(folder, task, episodes, progress=count_up_to(bar))
    _check_labels(study, cells, name, open_dataset(folder, task=task)[0])


def _check_labels(study: Study, cells: Sequence[Cell], task: str, data: TensorDictBase | None) -> None:
    """Raises, before any work, a ValueError for labels that select nothing or shares smaller than the labelled part."""
    if data is None:  # recorded later
        return
    # check every seed: its windows may lie in another number of trajectories
    wanted = {(cell.labels, cell.demonstrations, cell.seed): cell for cell in cells if cell.task == task}
    for cell in wanted.values():
        labelled, _ = study.train_config(cell).labels.budget(cell.seed).apply(data)
        subsample_trajectories(labelled, cell.demonstrations)


def _write_rows(study: Study, results: Mapping[Cell, Result]) -> list[dict[str, Any]]:
    """Writes ``cells.csv`` and returns its rows."""
    rows = [row for row, _ in results.values()]
    write_csv(study.out / "cells.csv", CELL_COLUMNS, rows)
    return rows


def _work(study: Study, cells: Sequence[Cell], results: dict[Cell, Result], machines: Machines) -> None:
    """Runs shared planners, then the cells that are not done; reads the result of each once, when it has ended."""
    planners: dict[Path, Job] = {}
    jobs: list[Job] = []
    for cell in cells:
        if results[cell][0]["status"] == "done":
            continue
        planner, needs = study.planner_folder(cell), None
        if planner is not None and study.given_planner(cell.task) is None and not _is_trained(planner):
            needs = planner
            if planner not in planners:
                planners[planner] = Job(planner)
                with suppress(OSError):  # if this cannot be written, the job itself reports why
                    prepare_cell(planner, study.planner_config(cell), None)
        folder = study.out / cell.folder
        jobs.append(Job(folder, needs))
        with suppress(OSError):
            prepare_cell(folder, study.train_config(cell), study.eval_config(cell))
    places = {study.out / cell.folder: cell for cell in cells}
    with progress_bar(len(planners) + len(jobs), "trainings", unit="training", smoothing=0.1) as bar:
        with closing(launch(run_cell, [*planners.values(), *jobs], machines)) as ended:
            for job, reason in ended:
                bar.update()
                bar.set_postfix_str(job.folder.name + (" FAILED" if reason else ""))
                if job.folder in places:
                    cell = places[job.folder]
                    results[cell] = cell_row(study.out, cell, label_unit=study.label_unit, reason=reason)
                    _write_rows(study, results)


def _is_trained(folder: Path) -> bool:
    try:
        return read_result(folder) is not None and (folder / "planner.safetensors").is_file()
    except RunDirectoryError:
        return False
