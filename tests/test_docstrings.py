# This source code is licensed under the MIT license found in the LICENSE file.
"""Public functions tell what they take, public classes show how they are used."""

import ast
from pathlib import Path

import torchrl_koap

PACKAGE = Path(torchrl_koap.__file__).parent


def public_definitions(kind):
    """File, name, node and docstring of every public module-level definition of the package."""
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, kind) and not node.name.startswith("_"):
                yield file.relative_to(PACKAGE), node.name, node, ast.get_docstring(node) or ""


def test_functions_of_several_arguments_tell_them():
    found = 0
    for file, name, node, text in public_definitions(ast.FunctionDef):
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        if len(arguments) > 1:
            found += 1
            assert "Args:" in text, f"{file}: the docstring of {name} lacks Args"
    assert found > 100


def test_classes_have_an_example():
    found = 0
    for file, name, node, text in public_definitions(ast.ClassDef):
        bases = [ast.unparse(base) for base in node.bases]
        plain = any(base == "NamedTuple" or base.endswith(("Error", "Warning")) for base in bases)
        if not plain and file.parts[0] != "commands":  # commands show themselves by --help
            found += 1
            assert ">>> " in text, f"{file}: class {name} has no example"
    assert found > 100
