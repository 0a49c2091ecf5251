# This source code is licensed under the MIT license found in the LICENSE file.
"""Methods from outside the package, by name: in this process, in others, after a kill, and what is said when not."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_runs import TINY

from torchrl_koap.runs.plugins import PluginError, load_plugins
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.studies.table import read_cells
from torchrl_koap.training.method import Method, Phase
from torchrl_koap.training.methods import METHODS, register_method

PLUGINS = Path(__file__).parents[1] / "plugins"
PLUGIN = ("--plugin", "nearest_neighbour")
ROOT = Path(__file__).parents[2]


def program(*arguments, folder=None, **options):
    """`koap` in a process of its own, which finds plugins in a folder."""
    path = os.pathsep.join(map(str, [ROOT, *([] if folder is None else [folder])]))
    command = [sys.executable, "-m", "torchrl_koap.commands.cli", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, timeout=300, **options
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory, demonstrations):
    """A run of the plugin's method; not to be written to."""
    out = tmp_path_factory.mktemp("plugin") / "run"
    made = program(
        "train", *PLUGIN, "--method", "nearest_neighbour", "--out", out, "--dataset", demonstrations, *TINY,
        folder=PLUGINS,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    return out


def test_a_run_of_a_plugin_s_method(run):
    config, summary = (json.loads((run / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert config["run"]["plugins"] == ["nearest_neighbour"] and config["method"] == "nearest_neighbour"
    remembered = load_tensors(run / "controller.safetensors")[0]["actions"]
    assert len(remembered) == summary["decoder_fit"]["labels_used"] > 20


def test_log_columns_follow_from_what_is_logged(run):
    rows = RunDirectory(run).read_metrics()
    assert [row["phase"] for row in rows] == ["planner", "controller"]
    assert float(rows[1]["loss_neighbours"]) > 0 and rows[0]["loss_neighbours"] == ""
    assert RunDirectory(run).last_metrics("controller")["loss_neighbours"] == float(rows[1]["loss_neighbours"])


def test_what_reads_the_run_imports_the_plugin_by_itself(run, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(run, out)
    done = program("eval", out, "--episodes", 1, "--threads", 1, "--no-report", folder=PLUGINS)
    assert done.returncode == 0 and "success_rate" in done.stdout, done.stderr
    weights = (out / "controller.safetensors").read_bytes()
    (out / "controller.safetensors").unlink()
    # found in the current directory as well, as by `python -m`
    again = program("train", "--out", out, "--resume", cwd=PLUGINS)
    assert again.returncode == 0 and (out / "controller.safetensors").read_bytes() == weights, again.stderr


def test_a_plugin_that_is_nowhere_is_named_with_where_it_was_looked_for(run, tmp_path):
    said = program("eval", run, "--episodes", 1, cwd=tmp_path)
    (line,) = said.stderr.splitlines()
    assert said.returncode == 1 and line.startswith("koap: there is no plugin 'nearest_neighbour'; looked for it in ")
    assert str(tmp_path) in line and "KOAP_TRACEBACK=1" in line


def test_a_curve_killed_goes_on_with_the_plugin_in_every_cell(tmp_path, demonstrations):
    """Killed when the first cell is done; the second call does not name the plugin, its folder does."""
    out, env = tmp_path / "curve", {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(PLUGINS)])}
    arguments = (
        *("curve", "--out", out, "--datasets", demonstrations, "--methods", "nearest_neighbour", "linear"),
        *("--labels", 0.25, "--seeds", 1, "--planner.steps", 3, "--controller.steps", 3),
        *("--evaluation.episodes", 1, "--workers", 1),
    )
    command = [sys.executable, "-m", "torchrl_koap.commands.cli", *map(str, arguments)]
    first = subprocess.Popen(
        [*command, "--run.plugin", "nearest_neighbour"], env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    mark = out / "cells/avoiding/nearest_neighbour-0.25-1-seed0/result.json"
    try:
        for _ in range(1200):
            if mark.exists() or first.poll() is not None:
                break
            time.sleep(0.1)
        assert mark.exists()
    finally:
        first.send_signal(signal.SIGKILL)
        first.wait()
    made = mark.stat().st_mtime_ns
    assert json.loads((out / "study.json").read_text())["run"]["plugins"] == ["nearest_neighbour"]
    second = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
    assert second.returncode == 0, second.stderr
    assert {row["method"]: row["status"] for row in read_cells(out / "cells.csv")} == {
        "nearest_neighbour": "done",
        "linear": "done",
    }
    assert mark.stat().st_mtime_ns == made
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
    with pytest.raises(PluginError, match="plugin 'twice_plugin' failed .*there is a method 'koap' already"):
        load_plugins(["twice_plugin"])
    with pytest.raises(PluginError, match="there is no plugin 'no_package.inside'; looked for it in"):
        load_plugins(["no_package.inside"])


@pytest.fixture
def methods(monkeypatch):
    """The table, put back afterwards."""
    for name in METHODS:
        monkeypatch.setitem(METHODS, name, METHODS[name])
    before = dict(METHODS)
    yield METHODS
    for name in set(METHODS) - set(before):
        del METHODS[name]


def test_what_is_no_method_is_refused(methods):
    loss, build = METHODS["dd"].phases[0].loss, METHODS["dd"].build
    register_method(Method("mine", "of mine", build))
    with pytest.raises(ValueError, match="there is a method 'mine' already"):
        register_method(Method("mine", "another", build))
    with pytest.raises(ValueError, match="unknown kind of windows 'labeled'; did you mean 'labelled'"):
        Method("other", "", build, sees="labeled")
    with pytest.raises(ValueError, match="the name of a method must be letters, digits"):
        Method("a/b", "", build)
    with pytest.raises(ValueError, match="phases of method 'other' need names of their own"):
        Method("other", "", build, (Phase("x", loss), Phase("x", loss)))
    with pytest.raises(ValueError, match="unknown kind of windows 'labeled'; did you mean 'labelled'"):
        Phase("x", loss, "labeled")
    with pytest.raises(ValueError, match="the teacher of method 'other' must be a controller, 'dp' is a policy"):
        register_method(Method("other", "", build, teacher="dp"))
    assert "other" not in METHODS


def test_installed_packages_announce_methods(methods, tmp_path, monkeypatch):
    """An entry point of the group torchrl_koap.methods is imported when a name is not known."""
    from torchrl_koap.training.methods import get_method

    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "announced_method.py").write_text(
        "from torchrl_koap.training import METHODS, Method, register_method\n"
        "register_method(Method('announced', 'from a package', METHODS['dd'].build))\n"
    )
    about = tmp_path / "announced-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: announced\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[torchrl_koap.methods]\nannounced = announced_method\n")
    assert get_method("announced").title == "from a package"
    with pytest.raises(ValueError, match="unknown method 'annuonced'; did you mean 'announced'"):
        get_method("annuonced")
