# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests signals, full devices and unusual settings: one line, and the exit status that shells expect."""

import os
import signal
import subprocess
import sys
import time
import warnings
from unittest.mock import Mock

import pytest
from tiny_runs import TINY, write_demonstrations

from torchrl_koap.commands import cli
from torchrl_koap.commands.shell import handling_signals, interrupt

COMMAND = (sys.executable, "-m", "torchrl_koap.commands.cli")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)])
def test_signals_are_like_ctrl_c(number, status, monkeypatch, capsys):
    def interrupted(arguments):
        os.kill(os.getpid(), number)
        time.sleep(5)

    monkeypatch.setattr(cli, "_run", interrupted)
    # whoever started the tests may have them ignore signals, as nohup does
    before = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    earlier = signal.signal(number, before)
    try:
        assert cli.main(["doctor"]) == status
        assert signal.getsignal(number) is before
    finally:
        signal.signal(number, earlier)
    by = "" if number == signal.SIGINT else f" by {number.name}"
    assert capsys.readouterr().err == f"koap: interrupted{by}\n"


@pytest.mark.parametrize("command", ["demos", "embed", "curve", "bench", "eval", "convert"])
def test_only_a_command_that_goes_on_when_called_again_says_so(command, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_run", Mock(side_effect=KeyboardInterrupt))
    assert cli.main([command, "x"]) == 130
    goes_on = "" if command in ("eval", "convert") else f"; `koap {command}` resumes when called again"
    assert capsys.readouterr().err == f"koap: interrupted{goes_on}\n"


def test_ignored_signals_stay_ignored():
    earlier = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with handling_signals(interrupt):
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, earlier)


@pytest.mark.parametrize("words", [["--out", ""], ["--out="], [""]])
def test_empty_words_are_refused(words, capsys):
    assert cli.main(["train", *words]) == 1
    assert "is a shell variable not set?" in capsys.readouterr().err


def test_a_narrow_terminal_gets_its_help(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "1")
    with pytest.raises(SystemExit) as left:
        cli.main(["doctor", "--help"])
    assert left.value.code == 0 and "--quiet" in capsys.readouterr().out


def test_out_of_memory_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(cli, "_run", Mock(side_effect=MemoryError))
    assert cli.main(["doctor"]) == 1
    assert capsys.readouterr().err.startswith("koap: out of memory; try fewer episodes")


def test_an_internal_error_shows_its_traceback(monkeypatch):
    monkeypatch.setattr(cli, "_run", Mock(side_effect=TypeError("ours")))
    with pytest.raises(TypeError, match="ours"):
        cli.main(["doctor"])


def test_a_warning_is_one_line(monkeypatch, capsys):
    def warn(arguments):
        sys.stdout.write(warnings.formatwarning("a picture was left out", UserWarning, "somewhere.py", 3, "code"))
        return 0

    monkeypatch.setattr(cli, "_run", warn)
    assert cli.main(["doctor"]) == 0
    assert capsys.readouterr().out == "warning: a picture was left out\n"
    assert "somewhere.py" in warnings.formatwarning("outside", UserWarning, "somewhere.py", 3)


def ended(*words, settings=None, output=subprocess.PIPE, number=None, after=0.0):
    process = subprocess.Popen(
        [*COMMAND, *words], stdout=output, stderr=subprocess.PIPE, text=True, env={**os.environ, **(settings or {})}
    )
    if number is not None:
        time.sleep(after)
        process.send_signal(number)
    return process.wait(), process.communicate()[1]


@pytest.mark.faults
def test_a_setting_with_which_nothing_can_be_imported():
    status, said = ended("doctor", settings={"MPLBACKEND": "bogus"})
    assert status == 1 and "'bogus' is not a valid value for backend" in said and len(said.splitlines()) == 1


@pytest.mark.faults
@pytest.mark.parametrize("chosen", ["bogus", "osmesa", "glfw", "egl", "off"])
@pytest.mark.parametrize("command", ["doctor", "eval"])
def test_a_missing_rendering_backend_only_skips_the_animation(command, chosen, copied_run):
    words = ("eval", str(copied_run), "--episodes", "1", "--threads", "1") if command == "eval" else ("doctor",)
    status, said = ended(*words, "--quiet", settings={"MUJOCO_GL": chosen, "DISPLAY": "", "WAYLAND_DISPLAY": ""})
    assert status == 0 and "Traceback" not in said
    if command == "eval":
        told = [line for line in said.splitlines() if line.startswith("warning: film.gif was not made")]
        assert len(told) + (copied_run / "plots" / "film.gif").exists() == 1
        assert (copied_run / "eval.json").exists() and (copied_run / "index.html").exists()


@pytest.mark.faults
@pytest.mark.parametrize("words", [("--version",), ("doctor",), ("--help",)])
def test_a_full_device(words):
    with open("/dev/full", "w") as full:
        status, said = ended(*words, output=full)
    assert status == 1 and said.startswith("koap: the output could not be written: No space left on device")
    assert len(said.splitlines()) == 1


CLOSED = """
import os, sys
from torchrl_koap.commands.shell import open_closed_streams
open_closed_streams()
print("lost"), print("lost", file=sys.stderr), sys.stdin.read(), sys.stdout.flush(), sys.stderr.flush()
os.write(1, b"lost"), os.write(2, b"lost")
with open(sys.argv[1], "w") as file:
    file.write(str(file.fileno()))
"""


def test_output_of_a_process_without_streams_goes_into_no_file(tmp_path):
    """A file that is opened with one of the three numbers would get what a library prints."""
    closed = lambda: [os.close(number) for number in range(3)]  # noqa: E731
    done = subprocess.run([sys.executable, "-c", CLOSED, tmp_path / "file"], preexec_fn=closed, close_fds=True)
    assert done.returncode == 0 and int((tmp_path / "file").read_text()) > 2


@pytest.mark.faults
@pytest.mark.parametrize("shell", ["2>/dev/full", "2>&-", ">&- 2>&- <&-"])
def test_a_training_goes_on_without_its_bar(shell, tmp_path):
    data = write_demonstrations(tmp_path / "data")
    words = [*COMMAND, "train", "--out", tmp_path / "run", "--dataset", data, *TINY]
    assert subprocess.run(["bash", "-c", f'"$@" {shell}', "bash", *words]).returncode == 0
    assert (tmp_path / "run" / "summary.json").exists()


@pytest.mark.faults
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("after", [0.5, 1.5])
def test_a_signal_while_everything_is_imported(number, after):
    status, said = ended("doctor", number=number, after=after)
    assert status in (128 + number, 0) and "Traceback" not in said and len(said.splitlines()) <= 1
