# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that `koap convert` warns of recordings, in every format, that would mislead a policy."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from fault_ledger import Fault, Place, check, meet, table
from recording_writers import LENGTH, WRITERS, columns


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
    "stamps that stand": (put("timestamp", np.zeros_like), "time stamps do not increase", ()),
    "stamps in ms": (put("timestamp", lambda t: 1000 * t), "'timestamp' gives .*timestamp_ms", ()),
    "a robot that stands": (put("q0", np.zeros_like), "robot: .*q0 never move", ("--robot", "q0")),
    "an offset": (put("q0", lambda q: q + 4e6), "", ()),
    "an offset of an action": (
        put("v0", lambda v: v + 4e6, actions=True),
        r"action column .* is at 4e\+06: subtract this",
        (),
    ),
    "a sparse action": (put("v0", sparse, actions=True), r"action column .*\(known in \d+\) is mostly empty", ()),
    "states that are NaN": (put("q0", sparse), "states are not finite, first at frame 1", ()),
    "an episode that comes back": (
        put("episode_id", lambda ids: np.arange(LENGTH) // 10 % 2),
        "episode_id 0 returns|frames are 0.05 to 0.55 s apart",
        (),
    ),
    "an unknown column": (lambda episode: None, "unknown column in drop_columns", ("--drop-columns", "q9")),
}
# LeRobot's names have another form, and some formats have no such column
ELSEWHERE = {
    *((form, "an episode that comes back") for form in ("lerobot", "hdf5", "minari")),
    *((form, "stamps in ms") for form in ("lerobot", "minari")),
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
        source = {"hdf5": "{arrays}/all.hdf5", "minari": "minari:arm/all-v0"}.get(form, "{arrays}")
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
