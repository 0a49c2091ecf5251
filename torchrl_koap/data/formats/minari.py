# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads recordings from a Minari data set on this machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchrl_koap.data.formats.columns import assemble
from torchrl_koap.data.formats.kinds import leaves, named_twice, numbered, spread
from torchrl_koap.data.formats.pieces import Piece
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import gathered, refuse
from torchrl_koap.lookup import import_extra

PREFIX = "minari:"


def read_minari(source: str, **options: Any) -> Recordings:
    """Reads a local Minari data set, such as ``"minari:D4RL/door/human-v2"``, without downloading anything.

    Dictionary observations are concatenated in the order of their names, tuples by number; images are skipped. The rate
    is ``render_fps`` of the environment. The options are those of
    :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    minari = import_extra("minari", "minari", "Minari data sets are read with")
    name, local = source.removeprefix(PREFIX), minari.list_local_datasets()
    if name not in local:
        known = ", ".join(sorted(local)) or "none"
        raise FileNotFoundError(
            f"Minari data set {name!r} is not on this machine (here: {known}); `minari download` it"
        )
    dataset = minari.load_dataset(name, download=False)
    pieces, faults = [], []
    for episode in dataset.iterate_episodes():
        states: dict[str, np.ndarray] = {}
        unread = [f"infos/{name}" for name, _ in leaves(episode.infos or {})]
        called = f"episode {episode.id}"
        for name, array in leaves(episode.observations):
            if array.ndim > 2 or array.dtype.kind not in "fiub":
                unread.append(name or "observation")
            else:
                columns = spread(name or "state", array)
                faults += [(called, fault) for fault in named_twice(states, columns)]
                states |= columns
        if not states:
            faults.append((called, "observations hold images, matrices or text only, no vectors of numbers"))
        if isinstance(episode.actions, (Mapping, tuple)):
            faults.append((called, "its actions are a Dict or Tuple, wanted one vector [T, a] of numbers"))
            continue
        steps = np.asarray(episode.actions)
        if steps.ndim > 2 or steps.dtype.kind != "f" and (steps.ndim < 2 or steps.dtype.kind not in "iub"):
            faults.append((called, f"actions must be [T, a], got {steps.dtype} {list(steps.shape)}"))
            continue
        pieces.append(Piece(str(episode.id), states, numbered("action", steps), unread=tuple(unread)))
    refuse(source, gathered(faults))
    rate, no_rate = _rate(dataset)
    return assemble(pieces, source, declared_hz=rate, no_rate=no_rate, **options)


def _rate(dataset: Any) -> tuple[float | None, str]:
    """Returns the rate of the environment, if known, and why it may be unknown."""
    try:
        rate = dataset.recover_environment().metadata.get("render_fps")
    except Exception as error:  # an environment that is not installed may raise anything; its rate is optional
        return None, f"the rate is unknown, as its environment cannot be made ({type(error).__name__}: {error})"
    return float(rate) if rate else None, "its environment declares no render_fps"
