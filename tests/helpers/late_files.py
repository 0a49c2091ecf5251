# This source code is licensed under the MIT license found in the LICENSE file.
"""What another process does a little later than it says."""

import time


def wait_for(text, folder, seconds=30):
    """Waits until a file holds the text: wandb's process writes a little later than ``finish`` returns."""
    wait_until(lambda: any(path.is_file() and text in path.read_bytes() for path in folder.rglob("*")), seconds)


def wait_until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
