# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from a Minari data set on this machine, and as one."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.recordings.recordings import Recordings, RecordingsError, make_recordings

PREFIX = "minari:"
_EXTRA = "pip install 'torchrl_koap[minari]'"
# entries of a data set's metadata that Minari itself has nothing like
_NAMES, _ACTION_NAMES, _RATE = "koap_state_names", "koap_action_names", "koap_control_hz"


def read_minari(name: str, *, control_hz: float | None = None) -> Recordings:
    """Reads a Minari data set that was downloaded or created before; nothing is fetched.

    Args:
        name (str): id of the data set, such as ``"D4RL/door/human-v2"``. Dictionary observations are laid side by side
            in the order of their names; images are skipped.

    Keyword Args:
        control_hz (float, optional): control steps per second. Default: ``render_fps`` of the data set's environment.

    Raises:
        RecordingsError: if the data set holds no usable observations, actions are no vectors of numbers, or no rate is
            known.
        FileNotFoundError: if there is no such data set on this machine.
        RuntimeError: if Minari is not installed (extra ``minari``).

    Examples:
        >>> from torchrl_koap.data.recordings import read_minari
        >>> read_minari("D4RL/door/human-v2", control_hz=50)  # doctest: +SKIP
    """
    if importlib.util.find_spec("minari") is None:
        raise RuntimeError(f"Minari data sets are read with an extra: {_EXTRA}")
    import minari

    local = minari.list_local_datasets()
    if name not in local:
        known = ", ".join(sorted(local)) or "none"
        raise FileNotFoundError(
            f"Minari data set {name!r} is not on this machine (here: {known}); `minari download` it"
        )
    dataset = minari.load_dataset(name, download=False)
    states, actions, names, skipped, problems = [], [], None, [], []
    for episode in dataset.iterate_episodes():
        tables, images = _tables(episode.observations)
        skipped += images
        if not tables:
            problems.append(f"episode {episode.id}: observations hold no numbers but images")
            continue
        names = _labels(tables)
        states.append(np.concatenate([table.astype(np.float64) for table in tables.values()], 1))
        steps = np.asarray(episode.actions)
        actions.append(steps[:, None] if steps.ndim == 1 and steps.dtype.kind == "f" else steps)
    about = dataset.storage.metadata
    if names is not None and len(about.get(_NAMES, ())) == len(names):
        names = list(about[_NAMES])
    if control_hz is None:
        control_hz = about.get(_RATE) or _rate(dataset)
        if control_hz is None:
            problems.append("its environment says nothing of render_fps: pass control_hz")
    if problems:
        raise RecordingsError(f"{PREFIX}{name}", problems)
    return make_recordings(
        states,
        actions,
        state_names=names,
        action_names=about.get(_ACTION_NAMES),
        control_hz=control_hz,
        skipped=skipped,
        source=f"{PREFIX}{name}",
    )


def write_minari(recordings: Recordings, out: str | Path) -> None:
    """Writes recordings as a Minari data set, where Minari keeps them (``MINARI_DATASETS_PATH``).

    States and actions are one vector each; their names and the rate are entries of the metadata. A trajectory ends
    truncated; rewards, which recordings have none of, are 0, and an action that is not known is NaN.

    Args:
        recordings (Recordings): what to write.
        out (str or Path): ``minari:`` and the id of the data set, which ends in its version: ``minari:arm/pick-v0``.

    Raises:
        ValueError: if it is no such id.
        FileExistsError: if there is a data set of that name.
        RuntimeError: if Minari is not installed (extra ``minari``).

    Examples:
        >>> from torchrl_koap.data import read_recordings
        >>> from torchrl_koap.data.recordings.minari import write_minari
        >>> write_minari(read_recordings("recordings"), "minari:arm/pick-v0")  # doctest: +SKIP
    """
    if importlib.util.find_spec("minari") is None:
        raise RuntimeError(f"Minari data sets are written with an extra: {_EXTRA}")
    import gymnasium
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id

    if not str(out).startswith(PREFIX):
        raise ValueError(f"a Minari data set is written to {PREFIX}NAME-v0, got {str(out)!r}")
    name = str(out).removeprefix(PREFIX)
    try:
        parse_dataset_id(name)
    except ValueError as error:
        raise ValueError(f"{name!r} is no id of a Minari data set (wanted NAMESPACE/NAME-v0): {error}") from error
    if name in minari.list_local_datasets():
        raise FileExistsError(f"there is a Minari data set {name!r} already; choose another --out")
    buffers = [
        EpisodeBuffer(
            id=index,
            observations=list(states),
            actions=list(actions),
            rewards=[0.0] * len(actions),
            terminations=[False] * len(actions),
            truncations=[False] * (len(actions) - 1) + [True],
            infos={},
        )
        for index, (states, actions) in enumerate(zip(recordings.states, recordings.actions, strict=True))
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # there is no author, algorithm or environment to name
        written = minari.create_dataset_from_buffers(
            name,
            buffers,
            observation_space=_unbounded(gymnasium, len(recordings.state_names)),
            action_space=_unbounded(gymnasium, len(recordings.action_names)),
            description="recordings written by torchrl_koap",
        )
    names = {_NAMES: list(recordings.state_names), _ACTION_NAMES: list(recordings.action_names)}
    written.storage.update_metadata(names | {_RATE: recordings.control_hz})


def _unbounded(gymnasium: Any, size: int) -> Any:
    return gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)


def _tables(observations: Any, name: str = "") -> tuple[dict[str, np.ndarray], list[str]]:
    """Entries ``[T, d]`` by name, and the names of those that are images."""
    if isinstance(observations, Mapping):
        tables: dict[str, np.ndarray] = {}
        images: list[str] = []
        for key in sorted(observations):
            inner, left = _tables(observations[key], f"{name}_{key}" if name else str(key))
            tables |= inner
            images += left
        return tables, images
    array = np.asarray(observations)
    if array.ndim > 2 or array.dtype.kind not in "fiu":
        return {}, [name or "observation"]
    return {name or "state": array.reshape(len(array), -1)}, []


def _labels(tables: Mapping[str, np.ndarray]) -> list[str]:
    return [
        key if table.shape[1] == 1 else f"{key}_{index}"
        for key, table in tables.items()
        for index in range(table.shape[1])
    ]


def _rate(dataset: Any) -> float | None:
    try:
        rate = dataset.recover_environment().metadata.get("render_fps")
    except Exception:  # an environment that is not installed can fail in any way, and only its rate is wanted
        return None
    return float(rate) if rate else None
