# This source code is licensed under the MIT license found in the LICENSE file.
"""A task as plain JSON types and back, so that a folder of data can hold the task it belongs to."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

from torchrl_koap.tasks.scene import Body, Scene, Shape, StartRegions
from torchrl_koap.tasks.task import Defaults, Modes, Task


def task_to_json(task: Task) -> dict[str, Any]:
    """A task as dictionaries, lists, strings and numbers.

    Args:
        task (Task): the task; what it names by import strings stays a string.

    Raises:
        TypeError: if a field holds an object instead of its import string.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> get_task("avoiding").to_json()["actions"]
        {'x': 'm', 'y': 'm'}
    """
    return {name: _plain(value, name) for name, value in asdict(task).items()}


def task_from_json(entries: dict[str, Any]) -> Task:
    """The task that :func:`task_to_json` wrote.

    Args:
        entries (dict): as read from JSON.

    Raises:
        ValueError: for an unknown or missing entry, or facts that do not fit each other.

    Examples:
        >>> import json
        >>> from torchrl_koap.tasks import Task, get_task
        >>> Task.from_json(json.loads(json.dumps(get_task("stacking").to_json()))) == get_task("stacking")
        True
    """
    values = {name: _tuples(value) for name, value in _known(Task, entries, "task").items()}
    values["modes"] = _make(Modes, entries.get("modes", {}), "modes")
    values["defaults"] = _make(Defaults, entries.get("defaults", {}), "defaults")
    values["bodies"] = tuple(_make(Body, body, "bodies") for body in entries.get("bodies", ()))
    scene = dict(entries.get("scene", {}))
    shapes = tuple(_make(Shape, shape, "scene.shapes") for shape in scene.pop("shapes", ()))
    values["scene"] = _make(Scene, scene, "scene", shapes=shapes)
    starts = entries.get("start_regions")
    values["start_regions"] = None if starts is None else _make(StartRegions, starts, "start_regions")
    return Task(**values)


def plain_task_from_json(entries: dict[str, Any]) -> Task:
    """The task that a data set or run brings along: plain facts, no code.

    A folder that somebody sent must not decide what is run.

    Args:
        entries (dict): as :func:`task_to_json` wrote them.

    Raises:
        ValueError: if the entries are damaged, or name code to import.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.tasks.json_format import plain_task_from_json
        >>> plain_task_from_json(get_task("avoiding").to_json())  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: task 'avoiding' names code in env, expert, ...; register it by --plugin instead
    """
    try:
        task = task_from_json(entries)
        code = import_strings_of(task)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise ValueError(f"the task is damaged: {error}") from error
    if code:
        raise ValueError(f"task {task.name!r} names code in {', '.join(code)}; register it by --plugin instead")
    return task


def import_strings_of(task: Task) -> dict[str, str]:
    """What a task names by import strings, and where: the code that using it may run.

    Args:
        task (Task): the task.

    Examples:
        >>> from torchrl_koap.tasks import Task, get_task
        >>> from torchrl_koap.tasks.json_format import import_strings_of
        >>> import_strings_of(get_task("avoiding"))["env"]
        'torchrl_koap.envs.avoiding:AvoidingEnv'
        >>> arm = Task(name="arm", observation_parts={"joints": 2}, actions={"a": "rad"}, position="joints")
        >>> import_strings_of(arm)
        {}
    """
    named = {field: getattr(task, field) for field in ("env", "expert", "goal", "score", "converter")}
    named |= {"tool_kinematics": task.tool_kinematics, "modes.index": task.modes.index}
    named |= {f"state.{part}": kind for part, kind in task.state.items() if ":" in kind}
    return {place: value for place, value in named.items() if value}


def _plain(value: Any, place: str) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry, f"{place}.{key}") for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry, place) for entry in value]
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    raise TypeError(f"{place} cannot be written to JSON: wanted an import string, got {value!r}")


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(entry) for key, entry in value.items()}
    return tuple(_tuples(entry) for entry in value) if isinstance(value, (list, tuple)) else value


def _known(kind: type, entries: dict[str, Any], place: str) -> dict[str, Any]:
    if not isinstance(entries, dict):
        raise ValueError(f"{place}: wanted an object, got {type(entries).__name__}")
    known = {field.name for field in fields(kind)}
    unknown = [name for name in entries if name not in known]
    if unknown:
        raise ValueError(f"{place}: unknown entry {unknown[0]!r}; known: {', '.join(sorted(known))}")
    if kind is Task:
        missing = [name for name in ("name", "observation_parts", "actions", "position") if name not in entries]
        if missing:
            raise ValueError(f"{place}: entry {missing[0]!r} is missing")
    return entries


def _make(kind: type, entries: dict[str, Any], place: str, **more: Any) -> Any:
    return kind(**{name: _tuples(value) for name, value in _known(kind, entries, place).items()}, **more)
