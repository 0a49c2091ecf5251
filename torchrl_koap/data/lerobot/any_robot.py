# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from a LeRobot data set of any robot: features and names as its own ``info.json`` has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.data.lerobot.files import given_names, read_info, read_lerobot_folder
from torchrl_koap.data.recordings import Recordings, RecordingsError, make_recordings

PREFIX = "observation."
IMAGES = ("image", "video")


def read_lerobot_recordings(root: str | Path, *, features: Sequence[str] | None = None) -> Recordings:
    """Reads states and actions of all episodes; episodes, or rows, without actions have no label.

    Args:
        root (str or Path): folder of a data set in format v2.x or v3.0.

    Keyword Args:
        features (sequence of str, optional): features that make up the state, in that order. Default: every feature
            named ``observation...`` that holds numbers; images are skipped and listed.

    Raises:
        RecordingsError: if there are no such features, or an image is asked for.
        RawFolderError: with the problems of all files: unreadable, missing columns, states that are not finite, rows or
            episodes that are missing.
        FileNotFoundError: if the folder is no LeRobot data set.
        RuntimeError: if pyarrow is not installed (extra ``lerobot``).

    Examples:
        >>> from torchrl_koap.data.lerobot.any_robot import read_lerobot_recordings
        >>> read_lerobot_recordings("/data/so100_pick", features=["observation.state"])  # doctest: +SKIP
    """
    root = Path(root)
    info = read_info(root)
    known = info.get("features") or {}
    observed = [name for name in known if name.startswith(PREFIX)]
    images = [name for name in observed if _is_image(known[name])]
    chosen = [name for name in observed if name not in images] if features is None else list(features)
    problems = [
        f"feature {name!r} is an image ({known[name].get('dtype')}): embed it first, it cannot be part of the state"
        for name in chosen
        if name in images
    ]
    problems += [
        f"info.json has no feature {name!r}; it has {', '.join(observed) or 'no observations'}"
        for name in chosen
        if name not in known
    ]
    if not chosen:
        problems.append(f"no feature {PREFIX}* holds numbers; there are {', '.join(observed) or 'none'}")
    if problems:
        raise RecordingsError(str(root), problems)
    folder = read_lerobot_folder(root, features=chosen, labels_needed=False)
    if folder.problems:
        raise RecordingsError(str(root), folder.problems)
    names = [label for name in chosen for label in _names(known[name], name, folder.widths[name])]
    width = folder.episodes[0].action.shape[1]
    return make_recordings(
        [episode.observation for episode in folder.episodes],
        [episode.action for episode in folder.episodes],
        state_names=names if len(set(names)) == len(names) else None,
        action_names=_names(known.get("action") or {}, "action", width),
        sources=[f"episode {episode.number}" for episode in folder.episodes],
        control_hz=_rate(info),
        skipped=images,
        source=str(root),
    )


def _names(feature: Mapping[str, Any], name: str, width: int) -> list[str]:
    """Names of a feature's columns: the given ones, or the feature's own with a number."""
    short = name.removeprefix(PREFIX)
    return given_names(feature, width) or ([short] if width == 1 else [f"{short}_{index}" for index in range(width)])


def _is_image(feature: Mapping[str, Any]) -> bool:
    return feature.get("dtype") in IMAGES or len(feature.get("shape") or [1]) > 1


def _rate(info: Mapping[str, Any]) -> float | None:
    fps = info.get("fps")
    return float(fps) if isinstance(fps, (int, float)) and fps > 0 else None
