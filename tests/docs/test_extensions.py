# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that every tutorial, command, subpackage and frame is on a generated page."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs" / "extensions"))

import api_pages  # noqa: E402
import command_pages  # noqa: E402
import method_pages  # noqa: E402
import pages  # noqa: E402
import run_tutorials  # noqa: E402
import task_pages  # noqa: E402
import tutorial_pages  # noqa: E402


@pytest.fixture(autouse=True)
def generated(tmp_path, monkeypatch):
    for module in (pages, tutorial_pages):
        monkeypatch.setattr(module, "GENERATED", tmp_path)
    return tmp_path


def test_every_tutorial_is_a_page_with_its_code_and_text(generated):
    tutorial_pages.write_tutorial_pages()
    for name in tutorial_pages.ORDER:
        page = (generated / "tutorials" / f"{name}.rst").read_text()
        source = (ROOT / "tutorials" / f"{name}.py").read_text()
        title = ast.get_docstring(ast.parse(source)).splitlines()[0].rstrip(".")
        assert page.startswith(f"{title}\n{'=' * len(title)}\n")
        assert ".. code-block:: python" in page and "Conclusion\n----------" in page
        for line in re.findall(r"^from torchrl_koap\S* import .*$", source, re.MULTILINE):
            assert f"   {line.strip()}" in page


def test_a_tutorial_that_is_not_listed_is_an_error(monkeypatch):
    monkeypatch.setattr(tutorial_pages, "ORDER", tutorial_pages.ORDER[1:])
    with pytest.raises(ValueError, match="differ.*few_labels"):
        tutorial_pages.write_tutorial_pages()


def test_the_digest_is_that_of_the_code_not_of_the_text(tmp_path):
    digests = []
    for number, text in enumerate(("x = 1", "# a word\nx   = 1\n", "x = 2", "if x:\n    y\nz", "if x:\n    y\n    z")):
        script = tmp_path / f"{number}.py"
        script.write_text(f'"""Docstring {number}."""\n{text}')
        digests.append(tutorial_pages.digest(script))
    assert digests[0] == digests[1] and len(set(digests)) == 4


def test_the_digest_is_the_same_on_every_python(tmp_path):
    (tmp_path / "script.py").write_text('"""Docstring."""\nprint(f"{x + 1:.2f} of {len([])}")')
    assert tutorial_pages.digest(tmp_path / "script.py") == "1635bce882f3"


def test_every_tutorial_has_the_output_of_its_code():
    assert {file.stem for file in tutorial_pages.OUTPUTS.glob("*.txt")} == set(tutorial_pages.ORDER)
    for name in tutorial_pages.ORDER:
        first, *printed = (tutorial_pages.OUTPUTS / f"{name}.txt").read_text().splitlines()
        code = tutorial_pages.digest(ROOT / "tutorials" / f"{name}.py")
        assert first == tutorial_pages.DIGEST + code, f"{name} has changed since: make tutorials"
        assert printed and (tutorial_pages.OUTPUTS / f"{name}.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("printed", "words", "figures"),
    [
        (["success 83.3 % (64-93)", "in 12 ms"], 0, 0),
        (["success 83.3 % (64-93)", "in 7.5 s"], 0, 0),  # times are not compared
        (["success  91.7 % (74-98)", "in 12 ms"], 0, 2),
        (["failure 83.3 % (64-93)", "in 12 ms"], 5, 0),
        (["success 83.3 % (64-93)"], 4, 0),
    ],
)
def test_words_of_a_tutorial_are_compared_and_figures_that_moved_are_told(printed, words, figures):
    found = run_tutorials.differences(["success 83.3 % (64-93)", "in 12 ms"], printed)
    assert [len(lines) for lines in found] == [words, figures]


def test_a_tutorial_that_prints_something_else_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "story.py").write_text("open('story.png', 'w')\nprint('all 3 of 4')\n")
    (tmp_path / "story.txt").write_text("# code: 0\nall 4 of 4\n")
    for name in ("FOLDER", "OUTPUTS"):
        monkeypatch.setattr(run_tutorials, name, tmp_path)
    assert run_tutorials.run("story", check=True).splitlines()[1:] == ["-all 4 of 4", "+all 3 of 4"]
    (tmp_path / "story.txt").write_text("# code: 0\nnone of 4\n")
    with pytest.raises(SystemExit, match="story.py prints other words than story.txt shows"):
        run_tutorials.run("story", check=True)
    (tmp_path / "story.py").write_text("print('none of 4')\n")
    with pytest.raises(SystemExit, match="story.py left no story.png"):
        run_tutorials.run("story", check=True)
    assert not (tmp_path / "story.png").exists()  # nothing is kept


def test_every_public_name_is_in_the_reference(generated):
    api_pages.write_api_pages()
    listed = "".join(path.read_text() for path in (generated / "api").glob("*.rst"))
    for name in ("KoopmanInverseDynamics", "LabelBudget", "Agent", "TrainConfig", "AvoidingEnv", "KOAPLoss"):
        assert f"``{name}``" in listed
    assert (generated / "api" / "torchrl_koap.modules.koopman.lifting.rst").exists()


def test_every_command_is_a_page_of_its_options(generated):
    command_pages.write_command_pages()
    train = (generated / "commands" / "train.rst").read_text()
    assert "--labels.fraction NUMBER" in train and "--steps N, --planner.steps N" in train and "\x1b" not in train
    assert "evaluate" in (generated / "commands" / "index.rst").read_text()
    assert {path.stem for path in (generated / "commands").iterdir()} >= {"index", "convert", "curve", "doctor", "eval"}


def test_success_never_stands_without_its_interval():
    assert pages.success("164", "180") == "91.1 % (86-94) of 180" and pages.success("", "180") == ""
    for name in ("koap", "mpc"):
        cells = [
            line
            for line in method_pages.measured(method_pages.METHODS[name]).splitlines()
            if re.search(r" of 1[28]0", line)
        ]
        assert cells and all(re.search(r"\d % \(\d+-\d+\) of 1[28]0", cell) for cell in cells)
    assert "mpc" in "".join(task_pages.measured_blocks(task_pages.TASKS["avoiding"]))
