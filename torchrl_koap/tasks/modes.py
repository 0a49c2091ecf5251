# This source code is licensed under the MIT license found in the LICENSE file.
"""The mode of a task in words: a mode number counts through the choices of :class:`~torchrl_koap.tasks.Modes`."""

from __future__ import annotations

import math

from torchrl_koap.tasks.registry import find_task


def mode_choices(task: str | None, num_modes: int | None = None) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Choices that make up a mode, the slowest digit first; a single one where the task names none.

    Args:
        task (str, optional): name of the task.
        num_modes (int, optional): number of modes, needed for a task without choices.

    Raises:
        ValueError: if the task names no choices and ``num_modes`` is not given.
    """
    known = find_task(task)
    if known is not None and known.modes.choices:
        return known.modes.choices
    if num_modes is None:
        raise ValueError(f"task {task!r} names no choices that make up its modes; wanted num_modes")
    return (("mode", tuple(str(index) for index in range(num_modes))),)


def mode_name(mode: int, task: str | None, num_modes: int | None = None) -> str:
    """A mode in words.

    Args:
        mode (int): number of the mode.
        task (str, optional): name of the task.
        num_modes (int, optional): number of modes, needed for a task without choices.

    Examples:
        >>> from torchrl_koap.tasks.modes import mode_name
        >>> mode_name(23, "avoiding"), mode_name(1, "sorting"), mode_name(-1, "avoiding")
        ('right, right, gap 4', 'red, blue, red, blue', 'no mode')
    """
    choices = mode_choices(task, num_modes)
    if not 0 <= mode < math.prod(len(names) for _, names in choices):
        return "no mode"
    words = []
    for _, names in reversed(choices):
        mode, digit = divmod(mode, len(names))
        words.append(names[digit])
    return ", ".join(reversed(words))
