# This source code is licensed under the MIT license found in the LICENSE file.
"""Registry of tasks: registered by import, or found through the entry-point group ``torchrl_koap.tasks``."""

from __future__ import annotations

from torchrl_koap.lookup import check_free, entry_points_of, lookup
from torchrl_koap.tasks.task import Task

GROUP = "torchrl_koap.tasks"
TASKS: dict[str, Task] = {}


def register_task(task: Task) -> Task:
    """Registers a task by its name, for Python and all commands.

    To register a task of your own, import the module that calls this function: by hand, with ``koap ... --plugin
    module``, or through an entry point in the group ``torchrl_koap.tasks`` (a module, or a :class:`Task` in it) of an
    installed package.

    Returns:
        Task: the task. Registering an equal task again is allowed.

    Raises:
        ValueError: if another task has the name.

    Examples:
        >>> from torchrl_koap.tasks import Action, Task, get_task, register_task
        >>> arm = Task(
        ...     name="doctest_arm", observation_parts={"joints": 2}, actions={"a": Action("rad")}, position="joints"
        ... )
        >>> register_task(arm) is get_task("doctest_arm")
        True
    """
    if not isinstance(task, Task):
        raise TypeError(f"wanted a Task, got {type(task).__name__}")
    if TASKS.get(task.name) != task:
        check_free(TASKS, task.name, "task", "torchrl_koap.tasks.TASKS")
    return TASKS.setdefault(task.name, task)


def get_task(name: Task | str) -> Task:
    """Looks a task up by name; searches the entry points of installed packages if the name is unknown.

    Returns:
        Task: the registered task, or ``name`` if it is a task.

    Raises:
        ValueError: if the name is unknown; the message suggests the nearest one.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> get_task("avoiding").state_columns, get_task("sorting").state_dim, get_task("po_sorting").state_dim
        ((2, 3), 18, 10)
    """
    if isinstance(name, Task):
        return name
    if not (isinstance(name, str) and name in TASKS):
        for found in entry_points_of(GROUP):
            if isinstance(found, Task):
                register_task(found)
    return lookup(TASKS, name, "task")


def task_from(name: str, definition: object) -> Task:
    """Returns the task of a data set or run: from its definition as :meth:`Task.to_json` wrote it, or by its name.

    A definition that names code is refused: a received folder must not choose the code that runs.
    """
    if definition is None:
        return get_task(name)
    try:
        task = Task.from_json(definition)
        code = task.import_strings()
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise ValueError(f"the task is damaged: {error}") from error
    if code:
        raise ValueError(f"task {task.name!r} names code in {', '.join(code)}; register it by --plugin instead")
    return task
