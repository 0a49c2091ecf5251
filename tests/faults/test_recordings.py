# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings of one's own robot in every format: whatever reads them, `koap convert` tells what would mislead a policy.

What is told, and when, is tested with the checks (tests/data); here one fault of a kind meets every reader.
"""

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


# what is done to every episode, what is said of it (nothing: it is accepted), and further words of the call
KINDS: dict[str, tuple[Callable, str, tuple[str, ...]]] = {
    "stamps that jitter": (put("timestamp", jitter), "the usual step is 0.05 s: pass resample .--resample. 20", ()),
    "stamps that jitter, resampled": (put("timestamp", jitter), "", ("--resample", "20", "--action-kind", "velocity")),
    "stamps in ms": (put("timestamp", lambda t: 1000 * t), "'timestamp' says .*timestamp_ms", ()),
    "a sparse action": (put("v0", sparse, actions=True), r"action column .*\(known in \d+\) is mostly empty", ()),
    "states that are NaN": (put("q0", sparse), "states are not finite, first at frame 1", ()),
    "an offset": (put("q0", lambda q: q + 4e6), "", ()),
    "sessions of trials": (
        lambda episode: episode[0].update({"session": np.arange(LENGTH) // 20, "trial": np.arange(LENGTH) // 10 % 2}),
        "",
        (),
    ),
    "an action of text": (put("v0", lambda v: v.astype(str) + "!", actions=True), "action", ()),
    "an unknown column": (lambda episode: None, "unknown column in drop_columns", ("--drop-columns", "q9")),
}
# these files have ends of episodes and names of clocks of their own, and HDF5 and Minari hold no text
ELSEWHERE = {
    *((form, "sessions of trials") for form in ("lerobot", "hdf5", "minari")),
    *((form, "an action of text") for form in ("hdf5", "minari")),
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
