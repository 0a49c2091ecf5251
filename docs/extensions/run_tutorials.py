# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs tutorials and keeps what they print and draw for the site.

python docs/extensions/run_tutorials.py              # all of them
python docs/extensions/run_tutorials.py planners     # one
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tutorial_pages import DIGEST, FOLDER, ORDER, OUTPUTS, digest


def run(name: str) -> float:
    """Runs a tutorial in an empty folder; returns the seconds it took.

    Args:
        name (str): its file without the ending.

    Raises:
        SystemExit: if it failed, with the end of what it said.
    """
    script, began = FOLDER / f"{name}.py", time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        env = {**os.environ, "OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1", "RL_LOGGING_LEVEL": "WARNING"}
        done = subprocess.run([sys.executable, script], cwd=folder, capture_output=True, text=True, env=env)
        if done.returncode:
            raise SystemExit(f"{script.name} failed:\n{done.stderr[-3000:]}")
        OUTPUTS.mkdir(exist_ok=True)
        (OUTPUTS / f"{name}.txt").write_text(f"{DIGEST}{digest(script)}\n{done.stdout}", encoding="utf-8")
        shutil.copyfile(Path(folder) / f"{name}.png", OUTPUTS / f"{name}.png")
    return time.monotonic() - began


if __name__ == "__main__":
    for chosen in sys.argv[1:] or ORDER:
        print(f"{chosen}: {run(chosen):.0f} s", flush=True)
