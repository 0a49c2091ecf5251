# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that pages are short and plain: number of words, length of sentences, forbidden words."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
BUDGET = 14_000  # words in the navigation, tables included, code not
LONGEST_MEAN = 18  # words a sentence
OUTSIDE = {"appendix", "generated", "outputs", "extensions", "_static"}
PAGES = sorted(page for page in DOCS.rglob("*.md") if not OUTSIDE & set(page.relative_to(DOCS).parts))
NAMES = {"oracle"}  # values of options
# looked up, not read
REFERENCE = {"tasks.md", "methods.md", "glossary.md", "changelog.md", "conduct.md"}
BANNED = re.compile(
    r"\b(told apart|pays?|paid|buys?|bought|(is|are) worth|money|honest(ly)?|leash|by heart|luck(y|ily)?|loud(ly)?"
    r"|in force|of before|the former|was wanted|tried and not kept|for the first time|in the wild|in secret"
    r"|postures?|oracles?|regimes?|beside the demonstrations|random play|ledgers?|keeps? its bits|embodies"
    r"|imagin(es?|ed)|joining|adopts?|adopted|dealt|forgives?|punish(es)?|verdicts?|foresee[sn]?|foresight|doubts?"
    r"|a (tenth|hundredth|fiftieth|twentieth|third|quarter|fifth) of)\b",
    re.IGNORECASE,
)
OLD_NAMES = {
    *("leash", "posture", "foresee", "foresight", "doubt", "doubts", "verdict", "joining", "exchange", "adopt"),
    *("adopted", "whose", "regime", "dealt", "judge", "judged", "imagined", "recipe", "place", "places"),
}


def text_of(page: Path) -> str:
    """A page with what it includes."""

    def included(found: re.Match[str]) -> str:
        return (page.parent / found[1]).read_text()

    return re.sub(r"```\{include\} (\S+)\n(?::[^\n]*\n)*```", included, page.read_text())


def text_of_tutorial(file: Path) -> list[str]:
    """Title and text of a tutorial, and its comments between cells."""
    lines = [line.removeprefix("#").strip() for line in re.findall(r"^# ?.*$", file.read_text(), re.MULTILINE)]
    return [ast.get_docstring(ast.parse(file.read_text())) or "", *(line for line in lines[1:] if line[:2] != "%%")]


def without_code(text: str) -> str:
    """Text and tables of a page, without code, directives, addresses and the marks of pictures."""
    text = re.sub(r"^(`{3,}).*?^\1|^---\n.*?^---\n|<!--.*?-->", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"!?\[([^\]]*)\]\([^)]*\)|\{\w+\}`([^`<]*)[^`]*`", r"\1\2", text)


def sentences_of(text: str) -> list[str]:
    """Sentences of a page: no tables, headings and formulas; an item of a list begins one."""
    text = re.sub(
        r"^(\||#|    ).*$|\$[^$\n]*\$", "", without_code(re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)), flags=re.MULTILINE
    )
    found = re.split(r"(?<=[.!?])\s+|\n\s*\n|\n(?:\*|-|\d+\.) |:\n", text)
    return [sentence for sentence in found if len(sentence.split()) > 1]


def mean_length(text: str) -> float:
    words = [len(sentence.split()) for sentence in sentences_of(text)]
    return sum(words) / max(1, len(words))


def banned(text: str) -> list[str]:
    """Words of a page that hide what is meant, code in backticks left out."""
    return [found[0] for found in BANNED.finditer(" ".join(re.sub(r"`[^`]*`", "", without_code(text)).split()))]


def test_the_navigation_has_a_budget_of_words():
    texts = {str(page.relative_to(DOCS)): without_code(text_of(page)) for page in PAGES}
    texts |= {file.stem: "\n".join(text_of_tutorial(file)) for file in sorted((ROOT / "tutorials").glob("*.py"))}
    words = {name: len(re.findall(r"\w\S*", text)) for name, text in texts.items()}
    assert sum(words.values()) <= BUDGET, sorted(words.items(), key=lambda item: -item[1])[:10]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_sentences_of_a_page_are_short_and_its_words_plain(page):
    text = text_of(page)
    if page.name not in REFERENCE and page.parent.name != "reference":
        longest = sorted(sentences_of(text), key=lambda sentence: -len(sentence.split()))[:3]
        assert mean_length(text) <= LONGEST_MEAN, longest
    assert not banned(text)


@pytest.mark.parametrize("file", sorted((ROOT / "tutorials").glob("*.py")), ids=lambda file: file.stem)
def test_text_of_tutorials_is_plain(file):
    text = "\n".join(text_of_tutorial(file)).replace("``", "`")
    assert mean_length(text) <= LONGEST_MEAN
    assert not banned(text)


def test_words_of_the_readme_the_appendix_and_generated_pages_are_plain():
    pages = [page.read_text() for page in (ROOT / "README.md", *sorted((DOCS / "appendix").glob("*.md")))]
    for file in sorted((DOCS / "extensions").glob("*.py")):
        nodes = ast.walk(ast.parse(file.read_text()))
        pages += [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    assert not (found := [word for page in pages for word in banned(page)]), found


def test_every_picture_has_a_description():
    for page in (ROOT / "README.md", *DOCS.rglob("*.md")):
        for description in re.findall(r"!\[([^\]]*)\]", page.read_text()):
            assert len(description.split()) >= 3, f"{page}: {description!r}"


def texts_of(tree: ast.Module) -> list[str]:
    """Docstrings, messages, help and what is printed, without names in quotes."""
    found = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [re.sub(r"[\"']\w+[\"']", "", text) for text in found if text not in NAMES]


@pytest.mark.parametrize("folder", ["torchrl_koap", "examples"])
def test_words_of_docstrings_and_messages_are_plain(folder):
    texts = {file: texts_of(ast.parse(file.read_text())) for file in sorted((ROOT / folder).rglob("*.py"))}
    found = [(file.name, word) for file, each in texts.items() for text in each for word in banned(text)]
    assert texts and not found


def test_old_words_are_no_public_names():
    for file in sorted((ROOT / "torchrl_koap").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                arguments = (*node.args.args, *node.args.kwonlyargs) if isinstance(node, ast.FunctionDef) else ()
                for name in (node.name, *(argument.arg for argument in arguments)):
                    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+", name)}
                    assert not words & OLD_NAMES, f"{file}: {node.name}: {name}"


def test_the_glossary_has_forty_terms_at_most_and_no_term_twice():
    rows = re.findall(r"^\| ([^|]+) \|", (DOCS / "glossary.md").read_text(), re.M)[1:]
    assert 20 <= len(rows) <= 40 and len({*rows}) == len(rows)
