# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws which frames are observed, planned, executed and read, with the numbers of the code."""

from __future__ import annotations

from typing import Any

from pages import write_file

from torchrl_koap.modules import PRESETS
from torchrl_koap.tasks import HISTORY, HORIZON, REPLAN_INTERVAL, WINDOW

LEFT, CELL, HIGH = 150, 30, 26


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: write_file("time.svg", drawing()))
    return {"parallel_read_safe": True}


def drawing() -> str:
    """Returns rows of frames as an SVG in the colours of the surrounding page."""
    preset = PRESETS["default"]
    past, ahead = preset["num_past"], preset["look_ahead"]
    first = past - HISTORY + 1  # earlier frames are read by the controller alone
    columns = first + WINDOW
    now = past
    parts = [text(LEFT + CELL * (index + 0.5), 18, time_name(index - now), "small") for index in range(columns)]
    rows = [
        ("planner observes", {**dict.fromkeys(range(first, first + HISTORY), "past"), now: "now"}),
        ("and plans", dict.fromkeys(range(now + 1, now + 1 + HORIZON), "")),
        ("executed of each plan", dict.fromkeys(range(now + 1, now + 1 + REPLAN_INTERVAL), "done")),
        (
            "controller reads, now",
            {
                **dict.fromkeys(range(now - past, now), "past"),
                now: "now",
                **dict.fromkeys((now + k for k in ahead), ""),
            },
        ),
        (
            "next plan observes",
            {
                **dict.fromkeys(range(first + REPLAN_INTERVAL, now + REPLAN_INTERVAL), "past"),
                now + REPLAN_INTERVAL: "now",
            },
        ),
    ]
    for row, (name, cells) in enumerate(rows):
        y = 28 + row * (HIGH + 12)
        parts.append(text(4, y + HIGH / 2 + 4, name, "left"))
        for index, kind in cells.items():
            x = LEFT + CELL * index
            parts.append(f'<rect class="{kind}" x="{x + 2}" y="{y}" width="{CELL - 4}" height="{HIGH}" rx="4"/>')
    width, height = LEFT + CELL * columns + 4, 28 + len(rows) * (HIGH + 12)
    head = f'<svg class="drawing" viewBox="0 0 {width} {height}" role="img" aria-label="frames in time">'
    return head + "".join(parts) + "</svg>\n"


def time_name(offset: int) -> str:
    """Returns ``now``, or the offset from it in frames."""
    return "now" if offset == 0 else f"{offset:+d}"


def text(x: float, y: float, words: str, kind: str) -> str:
    """Formats a text element."""
    return f'<text class="{kind}" x="{x:.0f}" y="{y:.0f}">{words}</text>'
