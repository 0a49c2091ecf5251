# This source code is licensed under the MIT license found in the LICENSE file.
"""Waits for files and conditions that another process completes with a delay."""

import time


def wait_for(text, folder, seconds=30):
    """Waits until a file contains the text: wandb's process still writes after ``finish`` has returned."""
    wait_until(lambda: any(path.is_file() and text in path.read_bytes() for path in folder.rglob("*")), seconds)


def wait_until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition did not become true in time"
        time.sleep(0.02)
