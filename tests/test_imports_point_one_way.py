# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests which subpackage may import which; code that needs another import belongs into another subpackage."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "torchrl_koap"
BASE = {"keys", "lookup", "files", "graphics"}
TRAINING = {*BASE, "tasks", "data", "vision", "modules", "objectives", "runs", "training"}
MAY_IMPORT = {
    "keys": {"files"},
    "lookup": set(),
    "files": {"lookup"},
    "graphics": set(),
    "tasks": {*BASE, "tasks"},
    "data": {*BASE, "tasks", "data"},
    "vision": {*BASE, "tasks", "data", "vision"},
    "envs": {*BASE, "tasks", "data", "vision", "envs"},
    "modules": {"keys", "lookup", "modules"},
    "objectives": {"keys", "lookup", "modules", "objectives"},
    "runs": {*BASE, "tasks", "data", "modules", "runs"},
    "training": TRAINING,
    "evaluation": {*TRAINING, "envs", "evaluation"},
    "reports": {*TRAINING, "envs", "evaluation", "reports"},
    "studies": {*TRAINING, "envs", "evaluation", "reports", "studies"},
    "commands": {*TRAINING, "envs", "evaluation", "reports", "studies", "commands", "__version__"},
}
IN_FUNCTIONS = {"training": {"envs"}}  # a simulator is loaded when it is asked for


def imports(node: ast.AST, inside: bool = False) -> Iterator[tuple[str, bool]]:
    """The room that every import names, and whether the import is inside a function."""
    for child in ast.iter_child_nodes(node):
        names = [alias.name for alias in child.names] if isinstance(child, ast.Import) else []
        if isinstance(child, ast.ImportFrom):
            assert not child.level, "relative import"
            names = [f"{child.module}.{alias.name}" for alias in child.names]
        yield from ((name.split(".")[1], inside) for name in names if name.startswith("torchrl_koap."))
        yield from imports(child, inside or isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)))


def test_only_rooms_and_four_files_are_at_the_top():
    names = {path.name for path in PACKAGE.iterdir() if path.name != "__pycache__"}
    assert names == {"__init__.py", "py.typed", *(f"{name}.py" for name in BASE), *(set(MAY_IMPORT) - BASE)}


@pytest.mark.parametrize("folder", ["tutorials", "benchmarks", "examples"])
def test_scripts_import_what_the_package_has(folder):
    for file in sorted((PACKAGE.parent / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "torchrl_koap":
                module = importlib.import_module(node.module)
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                for name in missing:  # a module of a room
                    importlib.import_module(f"{node.module}.{name}")


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_imports_point_one_way(room):
    files = [PACKAGE / f"{room}.py"] if room in BASE else sorted((PACKAGE / room).rglob("*.py"))
    for file in files:
        for name, inside in imports(ast.parse(file.read_text())):
            allowed = MAY_IMPORT[room] | (IN_FUNCTIONS.get(room, set()) if inside else set())
            assert name in allowed, f"{file.relative_to(PACKAGE)} imports {name}"


def test_no_other_subpackage_names_the_commands():
    files = [file for file in PACKAGE.rglob("*.py") if file.parent.name != "commands"]
    assert len(files) > 50 and not [file for file in files if "torchrl_koap.commands" in file.read_text()]


def test_training_loads_no_simulator_and_no_pictures():
    """Of what TorchRL does not load by itself: it looks for MuJoCo when its losses are imported."""
    script = (
        "import sys, torchrl.objectives\nbefore = set(sys.modules)\n"
        "import torchrl_koap.training\ntorchrl_koap.training.train\n"
        "print(*(name for name in set(sys.modules) - before if '.' not in name or 'torchrl_koap' in name))"
    )
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert "torchrl_koap.training.on_disk" in loaded
    assert not {"mujoco", "numba", "matplotlib", "dm_control", "PIL"} & set(loaded)
    rooms = {name.split(".")[1] for name in loaded if name.startswith("torchrl_koap.")}
    assert rooms == TRAINING
