# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests methods from outside the package in runs, in readers of runs, in cells, and in errors."""

import json
import shutil
import sys
from pathlib import Path
from unittest.mock import patch

import pytest
from command_calls import fails
from tiny_runs import TINY, koap, read_csv

from torchrl_koap.lookup import _run_file
from torchrl_koap.runs.plugins import PluginError, load_plugins
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.training import Trained
from torchrl_koap.training.method import Method, Phase
from torchrl_koap.training.methods import METHODS, get_method, register_method

NAME = "nearest_neighbour"
PLUGINS = Path(__file__).parents[1] / "plugins"


def forget():
    """Afterwards this process is like one that never heard of the plugin."""
    sys.modules.pop(NAME, None)
    METHODS.pop(NAME, None)


@pytest.fixture(autouse=True)
def search_path(monkeypatch):
    """Search path and methods without the plugin, put back afterwards."""
    forget()
    monkeypatch.setattr(sys, "path", [*sys.path])
    with patch.dict(METHODS):
        yield sys.path
    sys.modules.pop(NAME, None)


@pytest.fixture(scope="module")
def run(tmp_path_factory, demonstrations):
    """A run of the plugin's method; not to be written to."""
    out = tmp_path_factory.mktemp("plugin") / "run"
    words = ("--plugin", NAME, "--method", NAME, "--out", out, "--dataset", demonstrations, *TINY)
    with pytest.MonkeyPatch.context() as context:
        context.setattr(sys, "path", [*sys.path, str(PLUGINS)])
        assert koap("train", *words) == 0
    return out


def test_a_run_of_a_plugin_s_method(run):
    config, summary = (json.loads((run / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert config["run"]["plugins"] == [NAME] and config["method"] == NAME
    remembered = load_tensors(run / "controller.safetensors")[0]["actions"]
    assert len(remembered) == summary["decoder_fit"]["labels_used"] > 20


def test_what_reads_the_run_imports_the_plugin_by_itself(run, tmp_path, monkeypatch, search_path, capsys):
    out = tmp_path / "run"
    shutil.copytree(run, out)
    search_path.append(str(PLUGINS))
    assert koap("eval", out, "--episodes", 1, "--threads", 1, "--no-report") == 0 and NAME in METHODS
    assert "95 % interval" in capsys.readouterr().out
    weights = (out / "controller.safetensors").read_bytes()
    (out / "controller.safetensors").unlink()
    # found in the current directory as well, as by `python -m`
    forget()
    search_path.remove(str(PLUGINS))
    monkeypatch.chdir(PLUGINS)
    assert koap("train", "--out", out, "--resume") == 0 and NAME in METHODS
    assert (out / "controller.safetensors").read_bytes() == weights


def test_a_missing_plugin_is_named_with_the_searched_places(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = fails(capsys, "eval", run, "--episodes", 1)
    assert line.startswith(f"koap: there is no plugin {NAME!r}; looked for it in ")
    assert str(tmp_path) in line and "KOAP_TRACEBACK=1" in line


def test_a_study_goes_on_with_the_plugin_in_every_cell(tmp_path, demonstrations, search_path, job_server):
    """Cells are processes of their own; the second call does not name the plugin, its folder does."""
    search_path.append(str(PLUGINS))
    out = tmp_path / "curve"
    words = ("--datasets", demonstrations, "--labels", 0.25, "--seeds", 1, "--planner.steps", 3)
    words += ("--controller.steps", 3, "--evaluation.episodes", 1, "--workers", 1, "--methods", NAME)
    assert koap("curve", "--out", out, *words, "--run.plugin", NAME) == 0
    assert json.loads((out / "study.json").read_text())["run"]["plugins"] == [NAME]
    made = (out / f"cells/avoiding/{NAME}-0.25-1-seed0/result.json").stat().st_mtime_ns
    forget()
    assert koap("curve", "--out", out, *words, "linear") == 0
    assert {row["method"]: row["status"] for row in read_csv(out / "cells.csv")} == {NAME: "done", "linear": "done"}
    assert (out / f"cells/avoiding/{NAME}-0.25-1-seed0/result.json").stat().st_mtime_ns == made
    assert "nearest labelled steps" in (out / "index.html").read_text()


# what cannot be done


def test_a_plugin_that_fails_is_named_with_its_error(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "broken_plugin.py").write_text("import there_is_no_such_module")
    with pytest.raises(
        PluginError, match="plugin 'broken_plugin' failed .*ModuleNotFoundError: No module named 'there"
    ):
        load_plugins(["broken_plugin"])
    (tmp_path / "twice_plugin.py").write_text(
        "from torchrl_koap.training import METHODS, register_method; register_method(METHODS['koap'])"
    )
    with pytest.raises(
        PluginError, match="plugin 'twice_plugin' failed .*another method named 'koap' is registered already"
    ):
        load_plugins(["twice_plugin"])
    with pytest.raises(PluginError, match="there is no plugin 'no_package.inside'; looked for it in"):
        load_plugins(["no_package.inside"])


def test_a_plugin_may_be_a_file_that_no_import_finds(tmp_path):
    (tmp_path / "mine.py").write_text("raise SystemError('it was run')")
    with pytest.raises(PluginError, match="mine.py' failed when it was imported: SystemError: it was run"):
        load_plugins([str(tmp_path / "mine.py")])
    with pytest.raises(PluginError, match="there is no plugin file '.*/none.py'"):
        load_plugins([str(tmp_path / "none.py")])


def test_a_run_is_read_from_another_folder_than_that_of_its_plugin_file(demonstrations, tmp_path, monkeypatch):
    monkeypatch.chdir(PLUGINS)
    words = ("--plugin", f"./{NAME}.py", "--plugin", "json", "--method", NAME, "--dataset", demonstrations, *TINY)
    assert koap("train", *words, "--out", tmp_path / "run") == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["run"]["plugins"] == [str(PLUGINS / f"{NAME}.py"), "json"]
    monkeypatch.chdir(tmp_path)
    METHODS.pop(NAME)
    _run_file.cache_clear()  # as another process
    assert Trained.load("run").method.name == NAME


def test_what_is_no_method_is_refused():
    loss, build = METHODS["dd"].phases[0].loss, METHODS["dd"].build
    register_method(Method("mine", "of mine", build, closed_form=True))
    with pytest.raises(ValueError, match="another method named 'mine' is registered already"):
        register_method(Method("mine", "another", build, closed_form=True))
    with pytest.raises(ValueError, match="unknown kind of windows 'labeled'; did you mean 'labelled'"):
        Method("other", "", build, sees="labeled")
    for name in ("a/b", "..", ""):
        with pytest.raises(ValueError, match="the name of a method must be letters, digits"):
            Method(name, "", build)
    wrong = {
        "unknown preset 'papr'; did you mean 'paper'": {"presets": ("default", "papr")},
        "unknown controller.columns 'robots'; did you mean 'robot'": {"columns": "robots"},
        "controller.steps must be >= 0, got -1": {"updates": -1},
        "unknown option of an execution 'gian'; did you mean 'gain'": {"execution": {"gian": 1.0}},
    }
    for message, defaults in wrong.items():
        with pytest.raises(ValueError, match=message):
            Method("other", "", build, **defaults)
    for names in (("x", "x"), ("planner",)):
        with pytest.raises(ValueError, match="phases of method 'other' must have different names, not 'planner', got"):
            Method("other", "", build, tuple(Phase(name, loss) for name in names))
    with pytest.raises(ValueError, match="unknown kind of windows 'labeled'; did you mean 'labelled'"):
        Phase("x", loss, "labeled")
    with pytest.raises(ValueError, match="the teacher of method 'other' must be a controller, 'dp' is a policy"):
        register_method(Method("other", "", build, closed_form=True, teacher="dp"))
    with pytest.raises(ValueError, match="method 'other' trains nothing: give it phases, closed_form or fit"):
        Method("other", "", build)
    assert "other" not in METHODS


def test_installed_packages_announce_methods(tmp_path, monkeypatch):
    """An entry point of the group torchrl_koap.methods is imported when a name is not known."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "announced_method.py").write_text(
        "from torchrl_koap.training import METHODS, Method, register_method\n"
        "register_method(Method('announced', 'from a package', METHODS['dd'].build, METHODS['dd'].phases))\n"
    )
    about = tmp_path / "announced-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: announced\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[torchrl_koap.methods]\nannounced = announced_method\n")
    assert get_method("announced").title == "from a package"
    with pytest.raises(ValueError, match="unknown method 'annuonced'; did you mean 'announced'"):
        get_method("annuonced")
