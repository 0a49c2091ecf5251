# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings without what disturbs learning: frames in which nothing moves, trajectories that are too short."""

from __future__ import annotations

from dataclasses import replace

from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.data.quality import still_ends
from torchrl_koap.files import DataError
from torchrl_koap.tasks import WINDOW


def trim_still(recordings: Recordings) -> Recordings:
    """Cuts the frames at both ends of trajectories in which nothing moves; ``skipped`` counts them."""
    ends = still_ends(recordings.states)
    spans = [(start, len(frames) - end) for frames, (start, end) in zip(recordings.states, ends, strict=True)]
    return replace(
        recordings,
        states=[frames[start:end] for frames, (start, end) in zip(recordings.states, spans, strict=True)],
        actions=[steps[start : end - 1] for steps, (start, end) in zip(recordings.actions, spans, strict=True)],
        skipped=(*recordings.skipped, f"{ends.sum()} still frames of {ends.any(1).sum()} trajectories"),
    )


def drop_short(recordings: Recordings) -> Recordings:
    """Leaves out trajectories with fewer steps than a window; ``skipped`` names them.

    Raises:
        DataError: if none is left.
    """
    kept = [index for index, steps in enumerate(recordings.actions) if len(steps) >= WINDOW]
    if not kept:
        raise DataError("these recordings", f"no trajectory has the {WINDOW} steps of a window")
    short = [
        f"{name} ({len(steps)} steps)"
        for name, steps in zip(recordings.sources, recordings.actions, strict=True)
        if len(steps) < WINDOW
    ]
    return replace(
        recordings,
        states=[recordings.states[index] for index in kept],
        actions=[recordings.actions[index] for index in kept],
        sources=tuple(recordings.sources[index] for index in kept),
        skipped=(*recordings.skipped, *short),
    )
