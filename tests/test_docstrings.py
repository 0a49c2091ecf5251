# This source code is licensed under the MIT license found in the LICENSE file.
"""Public functions tell what they take, public classes show how they are used."""

import ast
import importlib
from pathlib import Path

import torchrl_koap

PACKAGE = Path(torchrl_koap.__file__).parent
SILENT = {"NotImplementedError", "AttributeError"}  # of a subclass to come, and of names that are no attribute


def public_definitions(kind):
    """File, name, node and docstring of every public module-level definition of the package."""
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, kind) and not node.name.startswith("_"):
                yield file.relative_to(PACKAGE), node.name, node, ast.get_docstring(node) or ""


def test_exported_functions_of_several_arguments_tell_them():
    names, found = exported(), 0
    for file, name, node, text in public_definitions(ast.FunctionDef):
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        if name in names and len(arguments) > 1:
            found += 1
            assert "Args:" in text, f"{file}: the docstring of {name} lacks Args"
    assert found > 20


def test_exported_classes_have_an_example():
    names, found = exported(), 0
    for file, name, node, text in public_definitions(ast.ClassDef):
        bases = [ast.unparse(base) for base in node.bases]
        plain = any(base == "NamedTuple" or base.endswith(("Error", "Warning")) for base in bases)
        if name in names and not plain:
            found += 1
            assert ">>> " in text, f"{file}: class {name} has no example"
    assert found > 50


def exported():
    """Names that a room, or the package itself, has in its ``__all__``."""
    names = set(torchrl_koap.__all__)
    for file in PACKAGE.glob("*/__init__.py"):
        room = importlib.import_module(f"torchrl_koap.{file.parent.name}")
        names |= set(vars(room).get("__all__", ()))
    return names


def raised(node):
    """Names of the exceptions that a function raises itself."""
    errors = [part.exc for part in ast.walk(node) if isinstance(part, ast.Raise) and part.exc is not None]
    names = {ast.unparse(error.func if isinstance(error, ast.Call) else error) for error in errors}
    return {name for name in names if name.endswith("Error")} - SILENT


def test_exported_functions_have_an_example():
    names, found = exported(), 0
    for file, name, _, text in public_definitions(ast.FunctionDef):
        if name in names:
            found += 1
            assert ">>> " in text, f"{file}: function {name} has no example"
    assert found > 30


def test_what_is_raised_is_told():
    names, found = exported(), 0
    for file, name, node, text in public_definitions((ast.FunctionDef, ast.ClassDef)):
        makers = [node] if isinstance(node, ast.FunctionDef) else []
        if isinstance(node, ast.ClassDef):
            makers = [part for part in node.body if getattr(part, "name", "") in ("__init__", "__post_init__")]
        if name in names and any(map(raised, makers)):
            found += 1
            assert "Raises:" in text, f"{file}: {name} raises {set().union(*map(raised, makers))}, and does not say so"
    assert found > 20


def test_exported_functions_tell_what_they_return():
    names, found = exported(), 0
    for file, name, node, text in public_definitions(ast.FunctionDef):
        if name in names and node.returns is not None and ast.unparse(node.returns) != "None":
            found += 1
            assert "Returns:" in text or "Yields:" in text, f"{file}: function {name} does not say what it returns"
    assert found > 30
