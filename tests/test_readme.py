# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the README: commands parse, code runs, links exist."""

import importlib.util
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

import torchrl_koap
from torchrl_koap import ControllerConfig, LabelConfig, PlannerConfig
from torchrl_koap.commands.options import FIRST, SHORT, parse
from torchrl_koap.commands.subcommands import Subcommand
from torchrl_koap.reports import pictures

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXT = "".join(page.read_text() for page in PAGES if "results" not in page.parts)
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
SHELL = [
    shlex.split(line, comments=True)
    for language, block in BLOCKS
    if language in ("bash", "sh", "console")
    for line in block.replace("\\\n", " ").splitlines()
]
MAKEFILE = (ROOT / "Makefile").read_text()
RECIPES = [
    shlex.split(line.replace("$(BIN)/", "").replace("$(OUT)", "runs/demo"))
    for line in MAKEFILE.splitlines()
    if "/koap " in line
]
CALLS = [words[1:] for words in (*SHELL, *RECIPES) if words and words[0] == "koap"]


def parsed(arguments):
    return parse(Subcommand, arguments)


def test_set_up_demo_and_tests_come_first():
    language, block = BLOCKS[0]
    assert language == "bash"
    assert [line.split("#")[0].strip() for line in block.splitlines()] == ["make demo", "make test"]


def test_targets_exist():
    for target in {words[1] for words in SHELL if words[:1] == ["make"]}:
        assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), target


@pytest.mark.parametrize("arguments", CALLS, ids=" ".join)
def test_commands_parse(arguments, monkeypatch):
    """With every extra: a launcher that is not installed is refused (tests/studies/test_launchers.py)."""
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: name == "ray" or found(name, *rest))
    options = parsed(arguments)
    assert type(options).__name__.lower() == arguments[0]


def test_every_command_is_shown():
    assert {"demos", "train", "eval", "validate", "doctor"} <= {arguments[0] for arguments in CALLS}
    assert len(CALLS) >= 8  # the three of `make demo` among them


def test_the_demo_has_the_documented_labels_and_rollouts():
    """`make demo` trains on 2 % of the trajectories and rolls out 60 times."""
    demos, train, evaluation = (parsed(words[1:]) for words in RECIPES)
    assert train.config.labels == LabelConfig(fraction=0.02)
    assert Path(train.config.dataset) == demos.out and demos.episodes == 96
    assert (Path(evaluation.run), evaluation.config.episodes) == (train.config.out, 60)


@pytest.mark.parametrize("code", [block for language, block in BLOCKS if language == "python"])
def test_python_runs(code, demonstrations, tmp_path, monkeypatch):
    """Everything runs, with fewer demonstrations, updates and rollouts than the text asks for."""
    train, evaluate, called = torchrl_koap.train, torchrl_koap.evaluate, []

    def train_shortly(config):
        called.append(config)
        few = {"planner": PlannerConfig(steps=8, width=8, batch_size=8), "controller": ControllerConfig(steps=8)}
        return train(replace(config, dataset=str(demonstrations), labels=LabelConfig(fraction=0.5), **few))

    def evaluate_shortly(run, config):
        called.append(config)
        return evaluate(run, replace(config, episodes=2))

    monkeypatch.setattr(torchrl_koap, "train", train_shortly, raising=False)
    monkeypatch.setattr(torchrl_koap, "evaluate", evaluate_shortly, raising=False)
    few = {"planner": {"steps": 1, "batch_size": 2, "width": 8}, "controller": {"steps": 1}}
    fit = torchrl_koap.fit
    monkeypatch.setattr(torchrl_koap, "fit", lambda *data, **asked: fit(*data, **(asked | few)), raising=False)
    monkeypatch.setattr(pictures, "_PICTURES", dict(pictures.all_pictures()))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    assert "train(" not in code or [type(config).__name__ for config in called] == ["TrainConfig", "EvalConfig"]


PATHS = re.findall(r"`((?:torchrl_koap|tutorials|examples|benchmarks|tests|docs)/[\w./]*)`", TEXT)


def test_links_lead_somewhere():
    found = [(page, link.split("#")[0]) for page in PAGES for link in re.findall(r"\]\(([^)]+)\)", page.read_text())]
    for page, link in found:
        if "://" in link or not link:
            continue
        assert (page.parent / link).exists(), f"{page}: {link}"
        assert "generated" not in Path(link).parts, f"{link} is not there before the documentation is built"


def test_paths_named_in_the_text_exist():
    assert not [path for path in sorted(set(PATHS)) if not (ROOT / path).exists()]


def test_usage_comes_before_any_figure():
    """The first screen says what it is and how it is used; results follow."""
    shell, plot = README.index("koap train"), README.index("paper_average.png")
    assert README.index("docs/pictures/pipeline.svg") < shell < README.index("import numpy") < plot
    assert len(README[:plot].splitlines()) < 70


def test_the_readme_is_short_and_plain():
    """At most 520 words of prose, with at most 16 in the mean sentence; it names the paper and who wrote it."""
    prose = re.sub(r"^```.*?^```|^\|.*?$|^!\[.*?$|^#.*?$|<!--.*?-->", "", README, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"\]\([^)]*\)", "]", prose)
    sentences = [each for each in re.split(r"(?<=[.:;!?])\s+|\n\s*\n|\n\* ", prose) if len(each.split()) > 1]
    words = [len(each.split()) for each in sentences]
    assert sum(words) <= 520
    assert sum(words) / len(words) <= 16
    assert "arxiv.org/abs/2410.07584" in README and "Bi et al." in README


def test_options_named_in_the_text_exist():
    """Every ``--option`` in running text is one of some command."""
    text = re.sub(r"^```.*?^```", "", TEXT, flags=re.MULTILINE | re.DOTALL)
    sources = "".join(path.read_text() for path in (ROOT / "torchrl_koap").rglob("*.py"))
    for option in re.findall(r"`--([a-z][a-z.-]*)", text):
        name = option.rpartition(".")[2].replace("-", "_")
        assert (
            f"--{option.rpartition('.')[2]}" in SHORT
            or option in FIRST
            or re.search(rf"^    {name}:", sources, re.MULTILINE)
        ), option


def test_no_placeholders_remain():
    assert not re.findall(r"@@|TODO|XXX|FIXME", TEXT)
