# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests what all commands share: calls, versions, logging to wandb, one command at a time in a folder."""

import re
import socket
import subprocess
import sys
from importlib.metadata import metadata, version
from pathlib import Path

import pytest
from command_calls import contents, fails
from late_files import wait_for
from tiny_runs import TINY, koap

import torchrl_koap
from torchrl_koap.commands.cli import HINT
from torchrl_koap.commands.options import FIRST, parse
from torchrl_koap.commands.subcommands import GROUPS, Subcommand
from torchrl_koap.runs.run_directory import RunDirectory


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["train"], "--out"),
        (["train", "--out", "x", "--device"], "--device"),
    ],
)
def test_a_wrong_call_exits_with_2_and_a_hint(arguments, hint, capsys):
    with pytest.raises(SystemExit) as left:
        koap(*arguments)
    assert left.value.code == 2
    out, err = capsys.readouterr()
    assert hint in err and "Traceback" not in err and out == ""


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("train --step 500", "unknown option of koap train: '--step'; did you mean '--steps'?"),
        ("train --out x --lables=5", "unknown option of koap train: '--lables'; did you mean '--labels'?"),
        ("latency x --step 4", "unknown option of koap latency: '--step'; did you mean '--steps'?"),
        ("convert x --control-h 30", "unknown option of koap convert: '--control-h'; did you mean '--control-hz'?"),
        ("validate x --foo", "unknown option of koap validate: '--foo'; known: --help, --quiet, --task, --plugin"),
        (
            "curve --out x --blend 0.5",
            "unknown option of koap curve: '--blend'; did you mean '--execution.blend'?",
        ),
        (
            "bench --table 1 --out x --preset table2",
            "unknown option of koap bench: '--preset'; did you mean '--controller.preset'?",
        ),
        ("trian --steps 5", "unknown command 'trian'; did you mean 'train'?"),
        ("train --out x --steps many", "--steps must be a whole number, got 'many'"),
        ("train --out x --seed=1.5", "--seed must be a whole number, got '1.5'"),
        ("convert x --out y --control-hz fast", "--control-hz must be a number, got 'fast'"),
        ("curve --out x --labels 0.1 few", "--labels must be a number, got 'few'"),
    ],
)
def test_a_wrong_argument_gets_one_line(call, said, capsys):
    with pytest.raises(SystemExit) as left:
        koap(*call.split())
    assert left.value.code == 2 and capsys.readouterr().err == f"koap: {said}\n"


def test_a_call_without_arguments_lists_every_command(capsys):
    assert koap() == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("usage: koap COMMAND") and "koap bench --table 1" in err


def help_of(capsys, *words):
    with pytest.raises(SystemExit) as left:
        koap(*words)
    assert left.value.code == 0
    return capsys.readouterr().out


def test_commands_are_listed_in_groups_each_with_an_example_that_parses(capsys):
    assert koap("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if re.fullmatch(r"\w+:", line)] == [f"{name}:" for name in GROUPS]
    assert max(map(len, lines)) <= 80
    examples = [line.split("$ koap ")[1].split() for line in lines if "$ koap " in line]
    assert [words[0] for words in examples] == [kind.__name__.lower() for group in GROUPS.values() for kind in group]
    for words in examples:
        assert type(parse(Subcommand, words)).__name__.lower() == words[0]


def test_twelve_options_of_a_training_come_first_and_all_on_request(capsys):
    first, every = help_of(capsys, "train", "--help"), help_of(capsys, "train", "--help-all")
    assert len(re.findall(r"^.? ?--\w", first, re.MULTILINE)) == 12 and "--help-all" in first
    assert "--planner.width N" in every and "planner options" in every and "--planner.width" not in first
    for name in FIRST.keys() - {"labels", "config"}:
        assert f"--{name}" in every


def test_a_curve_takes_the_environment_as_an_evaluation_does():
    words = ["--env", "X-v0", "--env-kwargs", "a=1", "--num-envs", "2", "--success-key", "won", "--episodes", "3"]
    asked = parse(Subcommand, ["curve", "--out", "x", *words]).config.evaluation
    assert asked == parse(Subcommand, ["eval", "x", *words]).config


@pytest.mark.parametrize("command", [kind.__name__.lower() for group in GROUPS.values() for kind in group])
def test_defaults_are_shown_once_and_only_if_informative(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of(capsys, command, "--help-all" if command == "train" else "--help")
    assert not re.findall(r"\{None\}|default: None|default: False|default: \)|--no-quiet|\[\w+ \[", text)
    for option in re.split(r"\n.? ?(?=--)", text)[1:]:
        assert option.count("(default") <= 1, option
    assert f"Example: `koap {command} " in text
    assert max(map(len, text.splitlines()[1:])) <= 80


def test_the_installed_program_gives_its_exit_status_and_one_line():
    """Through the installed entry point: exit status, and one line on stderr."""
    program = Path(sys.executable).with_name("koap")
    command = [str(program)] if program.exists() else [sys.executable, "-m", "torchrl_koap.commands.cli"]
    wrong = subprocess.run([*command, "eval", "run", "--seed="], capture_output=True, text=True)
    assert wrong.returncode == 1 and wrong.stdout == ""
    empty = "--seed is followed by an empty word: wanted a value; is a shell variable not set?"
    assert wrong.stderr == f"koap: {empty} ({HINT})\n"


def test_doctor_lists_versions(capsys):
    assert koap("doctor") == 0
    lines = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines())
    assert lines["torch"].strip() == version("torch") and lines["torchrl_koap"].strip() == "0.1.0"
    assert "MISSING" not in str(lines)
    assert {"python", "processors", "CUDA", "mujoco", "films are drawn with"} <= lines.keys()
    extras = metadata("torchrl_koap").get_all("Provides-Extra")
    assert {name.removeprefix("extra ") for name in lines if name.startswith("extra ")} == set(extras) - {"docs", "dev"}
    assert "installed" in lines["extra wandb"]


def test_demonstrations_are_recorded_once_and_are_valid(tmp_path, capsys):
    assert koap("demos", "--out", tmp_path / "demos", "--episodes", 2, "--seed", 4) == 0
    assert "2 demonstrations of avoiding" in capsys.readouterr().out
    assert "holds a data set, recordings or a run already; choose another --out" in fails(
        capsys, "demos", "--out", tmp_path / "demos"
    )
    assert koap("validate", tmp_path / "demos") == 0
    assert "no problem found" in capsys.readouterr().out


def test_wandb_stays_on_this_machine(demonstrations, tmp_path, monkeypatch):
    """Offline unless asked otherwise: a server at the configured address hears nothing, the logs are in the run."""
    pytest.importorskip("wandb")
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        monkeypatch.delenv("WANDB_MODE", raising=False)
        monkeypatch.setenv("WANDB_BASE_URL", f"http://127.0.0.1:{server.getsockname()[1]}")
        monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
        monkeypatch.setenv("WANDB_SILENT", "true")
        out = tmp_path / "run"
        assert koap("train", "--out", out, "--dataset", demonstrations, *TINY, "--logger", "wandb") == 0
        rolled = ("--episodes", "1", "--threads", "1", "--no-report")
        assert koap("eval", out, *rolled, "--logger", "wandb") == 0
        with pytest.raises(TimeoutError):
            server.accept()
    for text in (b"planner/loss_planner", b"eval/success_rate"):
        wait_for(text, out / "wandb")
    assert len(RunDirectory(out).read_metrics()) == 2 and not (tmp_path / "wandb").exists()


# what every command has


def test_version(capsys):
    assert koap("--version") == 0
    assert capsys.readouterr().out == f"koap {torchrl_koap.__version__}\n"


def test_quiet_prints_only_errors(demonstrations, tmp_path, capsys):
    command = ("train", "--out", tmp_path / "run", "--dataset", demonstrations, *TINY, "--quiet")
    assert koap(*command) == 0
    assert capsys.readouterr() == ("", "")
    assert "holds a run already" in fails(capsys, *command)


def test_two_trainings_in_one_folder(copied_run, capsys):
    """The second one is refused while the first one works, and leaves the folder alone."""
    with RunDirectory(copied_run).locked("koap train"):
        before = contents(copied_run)
        line = fails(capsys, "train", "--out", copied_run, "--resume")
        assert f"another command is working in {copied_run}: call `koap train` again" in line
        assert contents(copied_run) == before


def test_two_trainings_that_begin_together(demonstrations, tmp_path, capsys, monkeypatch):
    """Both found a new folder; while one reads its demonstrations the other one begins, or is through."""
    from torchrl_koap.training import on_disk

    out, load = tmp_path / "run", on_disk.open_dataset
    command = ("train", "--out", out, "--dataset", demonstrations, *TINY, "--quiet")

    def meanwhile(*arguments, **options):
        monkeypatch.setattr(on_disk, "open_dataset", load)
        assert koap(*command) == 0
        return load(*arguments, **options)

    monkeypatch.setattr(on_disk, "open_dataset", meanwhile)
    assert "holds a run already" in fails(capsys, *command)
    assert (out / "summary.json").exists()


def test_labels_of_the_call_take_the_place_of_those_in_a_file(tmp_path):
    file = tmp_path / "config.json"
    file.write_text('{"labels": {"count": 3, "unit": "window", "trajectories": 0.5}, "method": "linear"}')
    for words, fraction, count, unit in (
        (["--labels.fraction", "0.1"], 0.1, None, "window"),
        (["--labels=0.1"], 0.1, None, "trajectory"),
        (["--labels", "5"], None, 5, "trajectory"),
        ([], None, 3, "window"),
    ):
        config = parse(Subcommand, ["train", "--out", "x", "--config", str(file), *words]).config
        assert (config.labels.fraction, config.labels.count, config.method) == (fraction, count, "linear")
        assert (config.labels.unit, config.labels.trajectories) == (unit, 0.5)
    with pytest.raises(ValueError, match="there is no such file"):
        parse(Subcommand, ["train", "--out", "x", "--config", str(tmp_path / "none.json")])
