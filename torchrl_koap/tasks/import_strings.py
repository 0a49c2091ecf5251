# This source code is licensed under the MIT license found in the LICENSE file.
"""Import strings ``"package.module:name"``: what a task names without importing it, resolved on first use."""

from __future__ import annotations

import functools
import importlib
from typing import Any


def resolve(reference: Any, what: str) -> Any:
    """The object that an import string names; anything that is no string is returned as it is.

    Args:
        reference (str or object): ``"package.module:name"``, dots in ``name`` reach into a class.
        what (str): what the object is for; the error begins with it.

    Returns:
        object: what is named, or the argument itself.

    Raises:
        ValueError: if the string has no colon, the module cannot be imported, or it has no such name.

    Examples:
        >>> from torchrl_koap.tasks.import_strings import resolve
        >>> resolve("math:hypot", "goal of task 'toy'")(3, 4)
        5.0
        >>> resolve("math:hypotenuse", "goal of task 'toy'")
        Traceback (most recent call last):
        ...
        ValueError: goal of task 'toy': module 'math' has no 'hypotenuse' (asked for as 'math:hypotenuse')
    """
    if not isinstance(reference, str):
        return reference
    module, colon, name = reference.partition(":")
    if not (module and colon and name):
        raise ValueError(f"{what}: wanted an import string 'package.module:name', got {reference!r}")
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        raise ValueError(f"{what}: module {module!r} cannot be imported: {error}") from error
    try:
        return functools.reduce(getattr, name.split("."), found)
    except AttributeError:
        raise ValueError(f"{what}: module {module!r} has no {name!r} (asked for as {reference!r})") from None
