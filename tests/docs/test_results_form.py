# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that pages of results have one form, and that each number in their text is in a CSV file they link."""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "benchmarks" / "results"
PAGES = sorted((ROOT / "docs" / "results").glob("*.md"))
TEMPLATES = sorted(path for path in SOURCE.rglob("*.md.jinja") if path.name != "readme.md.jinja")
NUMBER = re.compile(r"(?<![\w.,-])\d+(?:,\d{3})*(?:\.\d+)?(?![\w-])")
COMMANDS = re.compile(r"```bash\n(.*?)```|block commands %\}(.*?)\{% endblock", re.DOTALL)
# question, picture with its description, caption, table, conclusions, commands, time, files
FORM = re.compile(
    r"# (?P<title>[^\n]+)\n\n\*(?P<question>[^\n]+\?)\*\n\n!\[(?P<alt>[^\]]+)\]\((?P<picture>[^)]+)\)\n\n"
    r"(?P<caption>[^\n]+)\n\n(?P<table>(?:\|[^\n]+\n)+)\n+## Conclusions\n\n(?P<conclusions>(?:\d\. [^\n]+\n)+)\n+"
    r"## Reproduce\n\n```bash\n(?P<commands>[^`]+)\n```\n\n(?:Time: (?P<time>[^\n]+?)\. )?Figures: (?P<files>[^\n]+)\n"
)


def plain(text: str) -> str:
    return re.sub(r"[*`_]", "", re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_have_one_form(page):
    form = FORM.fullmatch(page.read_text())
    assert form, f"{page.name} is not as benchmarks/results/page.jinja"
    assert len(form["alt"].split()) >= 5 and (page.parent / form["picture"]).exists()
    assert len(form["table"].splitlines()) - 2 <= 9
    conclusions = [line.split(". ", 1)[1] for line in form["conclusions"].splitlines()]
    assert len(conclusions) == 5 and conclusions[-1].startswith("Limits: ")
    assert all(len(plain(line).split()) <= 20 for line in conclusions), conclusions
    files = re.findall(r"\]\(([^)]+\.csv)\)", form["files"])
    assert files and all((page.parent / name).exists() for name in files)


def values_of(names) -> set[str]:
    """Every number of some CSV files; a share also in percent."""
    found = set()
    for name in names:
        with (SOURCE / f"{name}.csv").open(newline="") as file:
            for row in csv.reader(file):
                for number in NUMBER.findall(" ".join(row)):
                    found |= {number.replace(",", ""), f"{float(number.replace(',', '')):g}"}
                    if float(number.replace(",", "")) < 1:
                        found.add(f"{100 * float(number):g}")
    return found


def numbers_of_the_text(template: str) -> list[str]:
    """Numbers that somebody typed: no command, expression, code, link, year of a citation or number of a list."""
    text = re.sub(r"```.*?```|\{%[^%]*commands.*?endblock", "", template, flags=re.DOTALL)
    text = re.sub(
        r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}|`[^`]*`|\]\([^)]*\)|95 %|\(?et al\.?,? \d{4}\)?", "", text, flags=re.DOTALL
    )
    return [number.replace(",", "") for number in NUMBER.findall(re.sub(r"^\d\. ", "", text, flags=re.MULTILINE))]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_numbers_of_templates_are_those_of_the_files(path):
    template = path.read_text()
    linked = re.search(r"\{% set csv = \[(.*?)\]", template)
    names = re.findall(r'"([^"]+)"', linked[1]) if linked else re.findall(r'read_rows\("([^"]+)"', template)
    if not linked:  # an appendix, or a page of the reference
        names = [str(file.relative_to(SOURCE).with_suffix("")) for file in SOURCE.rglob("*.csv")]
    commands = " ".join("".join(found) for found in COMMANDS.findall(template))
    assert not set(numbers_of_the_text(template)) - values_of(names) - set(NUMBER.findall(commands))
