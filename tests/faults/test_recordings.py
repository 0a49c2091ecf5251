# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings of one's own robot in every format, with what would mislead a policy: each is told by `koap convert`."""

import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from fault_ledger import Fault, Place, check, meet, table
from recording_writers import LENGTH, WRITERS, columns
from tiny_runs import koap


def put(name: str, make: Callable[[np.ndarray], np.ndarray], *, actions: bool = False):
    return lambda episode: episode[int(actions)].update({name: make(episode[int(actions)].get(name, np.zeros(LENGTH)))})


def sparse(values: np.ndarray) -> np.ndarray:
    return np.where(np.arange(LENGTH) % 9, np.nan, values)


def jitter(times: np.ndarray) -> np.ndarray:
    return times + np.where(np.arange(LENGTH) % 7, 0, 0.02)


RESAMPLED = ("--resample", "20", "--action-kind", "velocity")
# what is done to every episode, what is said of it (nothing: it is accepted), and further words of the call
KINDS: dict[str, tuple[Callable, str, tuple[str, ...]]] = {
    "a hole in time": (put("timestamp", lambda t: t + 3 * (t > 1)), "frames are 0.05 to 3.05 s apart", ()),
    "stamps that jitter": (put("timestamp", jitter), "the usual step is 0.05 s: pass resample .--resample. 20", ()),
    "a hole in time, resampled": (put("timestamp", lambda t: t + 3 * (t > 1)), "", RESAMPLED),
    "stamps that jitter, resampled": (put("timestamp", jitter), "", RESAMPLED),
    "stamps that stand, resampled": (put("timestamp", np.zeros_like), "time stamps do not increase", RESAMPLED),
    "more than twice the rate": (lambda episode: None, "50 Hz is more than twice the rate", ("--resample", "50")),
    "changes or velocities": (lambda episode: None, "'change' or 'velocity'", ("--resample", "10")),
    "stamps that stand": (put("timestamp", np.zeros_like), "time stamps do not increase", ()),
    "stamps in ms": (put("timestamp", lambda t: 1000 * t), "'timestamp' says .*timestamp_ms", ()),
    "a robot that stands": (put("q0", np.zeros_like), "robot: .*q0 never move", ("--robot", "q0")),
    "an offset": (put("q0", lambda q: q + 4e6), "", ()),
    "an offset of an action": (
        put("v0", lambda v: v + 4e6, actions=True),
        r"action column .* is at 4e\+06: subtract that",
        (),
    ),
    "a sparse action": (put("v0", sparse, actions=True), r"action column .*\(known in \d+\) is mostly empty", ()),
    "states that are NaN": (put("q0", sparse), "states are not finite, first at frame 1", ()),
    "an episode that comes back": (
        put("episode_id", lambda ids: np.arange(LENGTH) // 10 % 2),
        "episode_id 0 comes back|frames are 0.05 to 0.55 s apart",
        (),
    ),
    "an end of text": (
        put("done", lambda d: np.array(["no"] * LENGTH)),
        "'done' .*no numbers|'done' must be numbers",
        (),
    ),
    "an end of halves": (put("done", lambda d: d + 0.5), "'done' of the ends of episodes must be 0 or 1", ()),
    "names of episodes": (put("episode", lambda e: np.array(["reach", "push"]).repeat(LENGTH // 2)), "", ()),
    "a start that is flagged": (put("is_first", lambda f: 1.0 * (np.arange(LENGTH) % 20 == 0)), "", ()),
    "sessions of trials": (
        lambda episode: episode[0].update({"session": np.arange(LENGTH) // 20, "trial": np.arange(LENGTH) // 10 % 2}),
        "",
        (),
    ),
    "whole numbers": (put("q0", lambda q: np.round(9 * q).astype(int)), "", ()),
    "an action of text": (put("v0", lambda v: v.astype(str) + "!", actions=True), "action", ()),
    "an unknown column": (lambda episode: None, "unknown column in drop_columns", ("--drop-columns", "q9")),
}
# an HDF5 file, a LeRobot set and Minari have their own ends of episodes, and no text; LeRobot's names have another form
OWN = ("an end of text", "an end of halves", "names of episodes", "a start that is flagged", "sessions of trials")
ELSEWHERE = {
    *((form, kind) for form in ("lerobot", "hdf5", "minari") for kind in OWN),
    ("lerobot", "an episode that comes back"),
    ("lerobot", "stamps in ms"),
    ("hdf5", "an episode that comes back"),
    ("hdf5", "an action of text"),
    ("minari", "an episode that comes back"),
    ("minari", "an action of text"),
    ("minari", "stamps in ms"),
}


def still(values: np.ndarray) -> np.ndarray:
    return values[np.maximum(np.arange(LENGTH) - 20, 0)]


def stand(episode) -> None:
    for part in episode:
        part.update({name: still(values) for name, values in part.items() if name != "timestamp"})


# what is done to every episode, and what `koap convert` and `koap validate` say of it, though they accept it
WARNED: dict[str, tuple[Callable, str]] = {
    "a wrapped angle": (put("q0", lambda q: (np.arange(LENGTH) / 4) % (2 * np.pi) - np.pi), "angles that were wrapped"),
    "a failed measurement": (
        put("q0", lambda q: np.where(np.arange(LENGTH) == 9, 1e3, q)),
        "a measurement that failed",
    ),
    "still frames": (stand, "nothing moves in 5.% of all frames at the start"),
    "a mark in states": (
        put("q0", lambda q: np.where(np.arange(LENGTH) % 9, q, -9999)),
        "a mark of what is missing. fill it",
    ),
    "a mark in actions": (
        put("v0", lambda v: np.where(np.arange(LENGTH) % 3, v, -999), actions=True),
        "a mark of what is missing. make it NaN",
    ),
    "an action of two values": (put("v0", lambda v: 1.0 * (v > 0), actions=True), "--action-kind raw delta"),
    "a count that wraps": (
        put("q0", lambda q: (np.arange(LENGTH) * 30 + 3300.5 + np.sin(np.arange(LENGTH))) % 4096),
        "a count or an angle that was wrapped",
    ),
    "a constant state": (put("q1", lambda q: 0 * q + 3), "'?q1'? is 3 in all"),
    "a constant action": (put("v1", lambda v: 0 * v + 2, actions=True), "is 2 in all labels"),
    "an action that leaps": (
        put("v0", lambda v: np.sin(np.arange(LENGTH) / 9) - 6.28 * (np.arange(LENGTH) == 7), actions=True),
        "far from that before and behind",
    ),
    "single labels": (
        lambda episode: [put(name, sparse, actions=True)(episode) for name in ("v0", "v1")],
        "labels stand alone",
    ),
}


def damage(kind: str, form: str) -> Callable[[Place], None]:
    def do(place: Place) -> None:
        folder = place.get("arrays")
        for file in folder.iterdir():
            file.unlink()
        episodes = [columns(seed) for seed in range(2)]
        for episode in episodes:
            (KINDS | WARNED)[kind][0](episode)
        WRITERS[form](folder, episodes)

    return do


def source_of(form: str) -> str:
    return {"hdf5": "{arrays}/all.hdf5", "minari": "minari:arm/all-v0"}.get(form, "{arrays}")


def faults() -> Iterator[Fault]:
    for form in WRITERS:
        source = source_of(form)
        for kind, (_, says, words) in KINDS.items():
            if (form, kind) not in ELSEWHERE:
                words = ("convert", source, "--out", "{out}", *words)
                yield Fault(f"{form}: {kind}", words, says, damage(kind, form), accepted=not says)
        for command in (("train", "--out", "{out}", "--dataset", source), ("validate", source)):
            says = r"`koap convert .*(all.hdf5|arrays|arm/all-v0) --out [\w-]+_data`, then `--dataset"
            yield Fault(f"{form}: not converted", command, says, damage("an unknown column", form))


@pytest.mark.parametrize("fault", table(faults()))
def test_what_would_mislead_is_told(fault, place, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(place.root / "arrays"))
    check(fault, meet(fault, place))


@pytest.mark.faults
@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("kind", WARNED)
def test_what_is_unlikely_is_told(kind, form, place, monkeypatch, capsys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(place.root / "arrays"))
    damage(kind, form)(place)
    words = ["convert", source_of(form).format(arrays=place.root / "arrays"), "--out", place.root / "out"]
    for call in (words if form != "minari" else [*words, "--control-hz", "20"], ["validate", place.root / "out"]):
        assert koap(*call) == 0
        assert re.search(WARNED[kind][1], " ".join(capsys.readouterr().out.split()))
