# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that public functions document their arguments and public classes show their use."""

import ast
import importlib
from pathlib import Path

import pytest

import torchrl_koap

PACKAGE = Path(torchrl_koap.__file__).parent
SILENT = {"NotImplementedError", "AttributeError"}  # of a subclass to come, and of names that are no attribute


def exported_definitions():
    """Name with its file, node and docstring of every definition that a room, or the package, has in ``__all__``."""
    names = set(torchrl_koap.__all__)
    for file in PACKAGE.glob("*/__init__.py"):
        room = importlib.import_module(f"torchrl_koap.{file.parent.name}")
        names |= set(vars(room).get("__all__", ()))
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name in names:
                yield f"{node.name} of {file.relative_to(PACKAGE)}", node, ast.get_docstring(node) or ""


def takes_several(node):
    return isinstance(node, ast.FunctionDef) and len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs) > 1


def returns_something(node):
    return isinstance(node, ast.FunctionDef) and node.returns is not None and ast.unparse(node.returns) != "None"


def raises(node):
    """Whether a function, or the making of an object of a class, raises an error itself."""
    makers = [node]
    if isinstance(node, ast.ClassDef):
        makers = [part for part in node.body if getattr(part, "name", "") in ("__init__", "__post_init__")]
    parts = [part for maker in makers for part in ast.walk(maker)]
    errors = [part.exc for part in parts if isinstance(part, ast.Raise) and part.exc is not None]
    names = {ast.unparse(error.func if isinstance(error, ast.Call) else error) for error in errors}
    return any(name.endswith("Error") for name in names - SILENT)


def is_no_record_or_error(node):
    """Records are read by their attributes: an example would repeat one."""
    bases = [ast.unparse(base) for base in getattr(node, "bases", ())]
    record = any("dataclass" in ast.unparse(part) for part in getattr(node, "decorator_list", ()))
    return not record and not any(base == "NamedTuple" or base.endswith(("Error", "Warning")) for base in bases)


@pytest.mark.parametrize(
    ("concerns", "sections", "least"),
    [
        (takes_several, ("Args:",), 20),
        (returns_something, ("Returns:", "Yields:"), 30),
        (raises, ("Raises:",), 20),
        (is_no_record_or_error, (">>> ",), 80),
    ],
    ids=["arguments", "results", "errors", "examples"],
)
def test_exported_definitions_document(concerns, sections, least):
    concerned = [(name, text) for name, node, text in exported_definitions() if concerns(node)]
    assert [name for name, text in concerned if not any(section in text for section in sections)] == []
    assert len(concerned) > least
