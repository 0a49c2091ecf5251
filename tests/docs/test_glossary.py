# This source code is licensed under the MIT license found in the LICENSE file.
"""One word per concept: the glossary is short, and words that it replaced do not come back."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "torchrl_koap").rglob("*.py"))
OLD_NAMES = {
    *("leash", "posture", "foresee", "foresight", "doubt", "doubts", "verdict", "joining", "exchange", "adopt"),
    *("adopted", "whose", "regime", "dealt", "judge", "judged", "imagined", "recipe", "place", "places"),
}


def public_definitions(tree: ast.Module):
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            yield node


def words_of(name: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+", name)}


def test_old_words_are_no_public_names():
    found = [(file, node) for file in FILES for node in public_definitions(ast.parse(file.read_text()))]
    for file, node in found:
        names = [node.name]
        if isinstance(node, ast.FunctionDef):
            names += [argument.arg for argument in (*node.args.args, *node.args.kwonlyargs)]
        for name in names:
            assert not words_of(name) & OLD_NAMES, f"{file}: {node.name}: {name}"


def test_the_glossary_has_forty_terms_at_most_and_no_term_twice():
    rows = re.findall(r"^\| ([^|]+) \|", (ROOT / "docs" / "glossary.md").read_text(), re.M)[1:]
    assert 20 <= len(rows) <= 40 and len({*rows}) == len(rows)
