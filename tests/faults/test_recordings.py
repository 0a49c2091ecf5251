# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings of one's own robot in every format, with what would mislead a policy: each is told by `koap convert`."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fault_ledger import Fault, Place, check, meet, table

Columns = dict[str, np.ndarray]
LENGTH, RATE = 40, 20.0


def columns(seed: int) -> tuple[Columns, Columns]:
    """States with their time stamps, and actions."""
    path = np.random.default_rng(seed).normal(size=(LENGTH, 3)).cumsum(0)
    states = {"timestamp": np.arange(LENGTH) / RATE} | {f"q{index}": path[:, index] for index in range(3)}
    return states, {f"v{index}": 0.1 * path[:, index] for index in range(2)}


def write_csv(folder: Path, episodes: list[tuple[Columns, Columns]]) -> None:
    for number, (states, actions) in enumerate(episodes):
        named = states | {f"action_{name}": values for name, values in actions.items()}
        with (folder / f"{number}.csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([list(named), *zip(*named.values(), strict=True)])


def write_npz(folder: Path, episodes: list[tuple[Columns, Columns]]) -> None:
    for number, (states, actions) in enumerate(episodes):
        observed = [name for name in states if name.startswith("q")]
        content = {name: values for name, values in states.items() if name not in observed}
        content |= {"states": np.stack([states[name] for name in observed], 1), "state_names": observed}
        np.savez(folder / f"{number}.npz", actions=np.stack(list(actions.values()), 1), **content)


def write_parquet(folder: Path, episodes: list[tuple[Columns, Columns]]) -> None:
    import pyarrow
    import pyarrow.parquet

    for number, (states, actions) in enumerate(episodes):
        named = states | {f"action_{name}": values for name, values in actions.items()}
        pyarrow.parquet.write_table(pyarrow.table(named), folder / f"{number}.parquet")


def write_lerobot(folder: Path, episodes: list[tuple[Columns, Columns]]) -> None:
    import pyarrow
    import pyarrow.parquet

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


def write_hdf5(folder: Path, episodes: list[tuple[Columns, Columns]]) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "all.hdf5", "w") as stream:
        for number, (states, actions) in enumerate(episodes):
            for name, values in states.items():
                stream[f"data/demo_{number}/obs/{name}"] = values
            stream[f"data/demo_{number}/actions"] = np.stack(list(actions.values()), 1)


WRITERS = {
    "csv": write_csv,
    "npz": write_npz,
    "parquet": write_parquet,
    "lerobot": write_lerobot,
    "hdf5": write_hdf5,
}


def put(name: str, make: Callable[[np.ndarray], np.ndarray], *, actions: bool = False):
    return lambda episode: episode[int(actions)].update({name: make(episode[int(actions)].get(name, np.zeros(LENGTH)))})


def sparse(values: np.ndarray) -> np.ndarray:
    return np.where(np.arange(LENGTH) % 9, np.nan, values)


def jitter(times: np.ndarray) -> np.ndarray:
    return times + np.where(np.arange(LENGTH) % 7, 0, 0.02)


# what is done to every episode, what is said of it, and further words of the call
KINDS: dict[str, tuple[Callable, str, tuple[str, ...]]] = {
    "a hole in time": (put("timestamp", lambda t: t + 3 * (t > 1)), "frames are 0.05 to 3.05 s apart", ()),
    "stamps that jitter": (put("timestamp", jitter), "the usual step is 0.05 s: resample", ()),
    "stamps that stand": (put("timestamp", np.zeros_like), "time stamps do not increase", ()),
    "stamps in ms": (put("timestamp", lambda t: 1000 * t), "'timestamp' says .*timestamp_ms", ()),
    "a robot that stands": (put("q0", np.zeros_like), "robot: .*q0 never move", ("--robot", "q0")),
    "an offset": (put("q0", lambda q: q + 4e6), "q0' moves by .*float32 .*subtract an offset", ()),
    "a sparse action": (put("v0", sparse, actions=True), r"action column .*\(known in \d+\) is mostly empty", ()),
    "states that are NaN": (put("q0", sparse), "states are not finite at frame 1", ()),
    "an episode that comes back": (
        put("episode_id", lambda ids: np.arange(LENGTH) // 10 % 2),
        "episode_id 0 comes back|frames are 0.05 to 0.55 s apart",
        (),
    ),
    "an action of text": (put("v0", lambda v: v.astype(str) + "!", actions=True), "action", ()),
    "an unknown column": (lambda episode: None, "unknown column in drop_columns", ("--drop-columns", "q9")),
}
ELSEWHERE = {  # an HDF5 file and a LeRobot set have their own ends of episodes; LeRobot's names have another form
    ("lerobot", "an episode that comes back"),
    ("lerobot", "stamps in ms"),
    ("hdf5", "an episode that comes back"),
    ("hdf5", "an action of text"),
}


def damage(kind: str, form: str) -> Callable[[Place], None]:
    def do(place: Place) -> None:
        folder = place.get("arrays")
        for file in folder.iterdir():
            file.unlink()
        episodes = [columns(seed) for seed in range(2)]
        for episode in episodes:
            KINDS[kind][0](episode)
        WRITERS[form](folder, episodes)

    return do


def faults() -> Iterator[Fault]:
    for form in WRITERS:
        source = "{arrays}/all.hdf5" if form == "hdf5" else "{arrays}"
        for kind, (_, says, words) in KINDS.items():
            if (form, kind) not in ELSEWHERE:
                yield Fault(f"{form}: {kind}", ("convert", source, "--out", "{out}", *words), says, damage(kind, form))
        for command in (("train", "--out", "{out}", "--dataset", source), ("validate", source)):
            says = rf"`koap convert {'.*all.hdf5' if form == 'hdf5' else '.*arrays'} --out \w+_data`, then `--dataset"
            yield Fault(f"{form}: not converted", command, says, damage("an unknown column", form))


@pytest.mark.parametrize("fault", table(faults()))
def test_what_would_mislead_is_told(fault, place):
    check(fault, meet(fault, place))
