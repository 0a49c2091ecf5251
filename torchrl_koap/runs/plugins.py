# This source code is licensed under the MIT license found in the LICENSE file.
"""Modules outside the package that register tasks, methods or pictures, imported by name (``--plugin``)."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from torchrl_koap.lookup import absolute, import_code

# an option field: a tuple of module names; on the command line `--plugin NAME`, which may be repeated
Plugins = Annotated[tuple[str, ...], tyro.conf.arg(name="plugin", metavar="MODULE"), tyro.conf.UseAppendAction]


class PluginError(ValueError):
    """A plugin that cannot be found, or whose import fails."""


def load_plugins(names: Sequence[str]) -> None:
    """Imports modules (dotted names or files ``*.py``), which register something then; later calls do nothing.

    The current directory is searched after the Python path, so that a file beside the data is found. A PluginError
    names a missing module and the folders searched, or the error of its import.
    """
    names = absolute_files(names)
    here = os.getcwd()
    if names and here not in sys.path and "" not in sys.path:
        sys.path.append(here)
        importlib.invalidate_caches()
    for name in names:
        if name.endswith(".py") and not os.path.isfile(name):
            raise PluginError(f"there is no plugin file {name!r}; give its present path with --plugin")
        try:
            import_code(name)
        except Exception as error:
            absent = error.name if isinstance(error, ModuleNotFoundError) else None
            if absent is not None and (name == absent or name.startswith(f"{absent}.")):
                places = dict.fromkeys(path or here for path in [here, *sys.path])
                raise PluginError(f"there is no plugin {name!r}; looked for it in {', '.join(places)}") from error
            said = f"plugin {name!r} failed when it was imported: {type(error).__name__}: {error}"
            raise PluginError(said) from error


def absolute_files(names: Sequence[str]) -> tuple[str, ...]:
    """Returns plugins with absolute paths of files, which are valid in every folder; keeps module names."""
    if isinstance(names, str):
        raise PluginError(f"plugins must be a sequence of module names, got the string {names!r}")
    return tuple(absolute(str(name)) for name in names)
