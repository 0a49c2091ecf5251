# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes the same recordings in every supported format."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

Columns = dict[str, np.ndarray]
Episodes = list[tuple[Columns, Columns]]  # states with their time stamps, and actions
LENGTH, RATE = 40, 20.0


def columns(seed: int) -> tuple[Columns, Columns]:
    """Returns states with their time stamps, and actions."""
    path = np.random.default_rng(seed).normal(size=(LENGTH, 3)).cumsum(0)
    states = {"timestamp": np.arange(LENGTH) / RATE} | {f"q{index}": path[:, index] for index in range(3)}
    return states, {f"v{index}": 0.1 * path[:, index] for index in range(2)}


def write_csv(folder: Path, episodes: Episodes) -> str:
    for number, (states, actions) in enumerate(episodes):
        named = states | {f"action_{name}": values for name, values in actions.items()}
        with (folder / f"{number}.csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([list(named), *zip(*(v.tolist() for v in named.values()), strict=True)])
    return str(folder)


def write_npz(folder: Path, episodes: Episodes) -> str:
    for number, (states, actions) in enumerate(episodes):
        observed = [name for name in states if name.startswith("q")]
        content = {name: values for name, values in states.items() if name not in observed}
        content |= {"states": np.stack([states[name] for name in observed], 1), "state_names": observed}
        np.savez(folder / f"{number}.npz", actions=np.stack(list(actions.values()), 1), **content)
    return str(folder)


def write_parquet(folder: Path, episodes: Episodes) -> str:
    pyarrow = pytest.importorskip("pyarrow")
    pytest.importorskip("pyarrow.parquet")

    for number, (states, actions) in enumerate(episodes):
        named = states | {f"action_{name}": values for name, values in actions.items()}
        pyarrow.parquet.write_table(pyarrow.table(named), folder / f"{number}.parquet")
    return str(folder)


def write_lerobot(folder: Path, episodes: Episodes) -> str:
    pyarrow = pytest.importorskip("pyarrow")
    pytest.importorskip("pyarrow.parquet")

    (folder / "meta").mkdir()
    (folder / "data").mkdir()
    states, actions = episodes[0]
    features = {f"observation.{name}": {"dtype": "float32", "shape": [1]} for name in states if name != "timestamp"}
    features["action"] = {"dtype": "float32", "shape": [len(actions)], "names": list(actions)}
    (folder / "meta/info.json").write_text(json.dumps({"fps": RATE, "features": features}))
    for number, (states, actions) in enumerate(episodes):
        rows = {name if name == "timestamp" else f"observation.{name}": values for name, values in states.items()}
        rows |= {"action": list(np.stack(list(actions.values()), 1)), "frame_index": np.arange(len(states["q0"]))}
        rows["episode_index"] = np.full(len(states["q0"]), number)
        pyarrow.parquet.write_table(pyarrow.table(rows), folder / f"data/{number}.parquet")
    return str(folder)


def write_hdf5(folder: Path, episodes: Episodes) -> str:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "all.hdf5", "w") as stream:
        for number, (states, actions) in enumerate(episodes):
            for name, values in states.items():
                stream[f"data/demo_{number}/obs/{name}"] = values
            stream[f"data/demo_{number}/actions"] = np.stack(list(actions.values()), 1)
    return str(folder / "all.hdf5")


def store_minari(root: Path, name: str, space, action_space, episodes: list[tuple], infos=None) -> str:
    """Writes through Minari's own storage, since its collector needs further packages."""
    pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    (root / name / "data").mkdir(parents=True)
    storage = MinariStorage.new(root / name / "data", space, action_space)
    for number, (observations, actions) in enumerate(episodes):
        steps = len(actions)
        rest = {"rewards": [0.0] * steps, "truncations": [False] * steps, "infos": infos or {}}
        ends = [False] * (steps - 1) + [True]
        storage.update_episodes(
            [EpisodeBuffer(id=number, observations=observations, actions=actions, terminations=ends, **rest)]
        )
    storage.update_metadata({"dataset_id": name, "minari_version": "0.5.4"})
    return f"minari:{name}"


def write_minari(folder: Path, episodes: Episodes) -> str:
    """Writes a data set; MINARI_DATASETS_PATH must be the folder."""
    states, actions = episodes[0]
    space = Dict({name: Box(0, 1, (1,), values.dtype) for name, values in states.items()})
    stored = [
        (
            {name: list(values[:, None]) for name, values in states.items()},
            list(np.stack(list(actions.values()), 1)[:-1]),
        )
        for states, actions in episodes
    ]
    return store_minari(folder, "arm/all-v0", space, Box(-np.inf, np.inf, (len(actions),)), stored)


WRITERS = {
    "csv": write_csv,
    "npz": write_npz,
    "parquet": write_parquet,
    "lerobot": write_lerobot,
    "hdf5": write_hdf5,
    "minari": write_minari,
}
