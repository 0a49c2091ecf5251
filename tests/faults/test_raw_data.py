# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw demonstrations and data sets on disk: every file, damaged in every way; and hostile ones.

Entries that are wrong are named by the readers themselves: tests/data/d3il and tests/data/test_ted.py.
"""

import json
import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_ledger import DAMAGE, Fault, Place, check, edit_json, flip, meet, table

from torchrl_koap.files import sha256_of

FILE = "env_003_00.pkl"
CALLS = {
    "data": (("validate", "{data}"), ("train", "--out", "{out}", "--dataset", "{data}", "--steps", "2")),
    "ted": (("validate", "{ted}"), ("train", "--out", "{out}", "--dataset", "{ted}", "--steps", "2")),
}


class Hostile:
    """Runs a command when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def deep(depth: int) -> bytes:
    return b"\x80\x02" + b"]" * depth + b"a" * (depth - 1) + b"."


HOSTILE = {  # all others are refused by tests/data/d3il/test_unpickling.py
    "system": pickle.dumps(Hostile(os.system, "touch owned")),
    "nested lists": deep(100_000),
    "two pickles": pickle.dumps({"robot": {"c_pos": np.zeros((30, 3))}}) * 2,
    "an archive": b"PK\x03\x04" + bytes(500),
    "a script": b"import os\nos.system('touch owned')\n",
}
STEPS = "steps.safetensors"
FORGERIES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a longer shape": lambda header: header["action"].update(shape=[10**9, 2]),
    "no element type": lambda header: header["action"].update(dtype="nothing"),
    "bytes beyond": lambda header: header["action"].update(data_offsets=[0, 10**12]),
    "shared bytes": lambda header: header["action"].update(data_offsets=header["observation"]["data_offsets"]),
    "an entry of another length": lambda header: header.update(other={**header["action"], "shape": [2, 268]}),
    "no action": lambda header: header.pop("action"),
}


def at(part: str, name: str, damage: Callable[[Path], object]) -> Callable[[Place], object]:
    return lambda place: damage(place.get(part) / name)


def forged(damage: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Damage of the header by somebody who has made the checksum fit."""

    def do(path: Path) -> None:
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + size])
        damage(header)
        written = json.dumps(header).encode()
        path.write_bytes(len(written).to_bytes(8, "little") + written + content[8 + size :])
        sound = {"sha256": sha256_of(path), "bytes": path.stat().st_size}
        edit_json(path.with_name("about.json"), lambda about: about.update(sound))

    return do


def faults() -> Iterator[Fault]:
    for kind, content in HOSTILE.items():
        hostile = at("data", FILE, lambda path, content=content: path.write_bytes(content))
        yield Fault(f"hostile {kind}", CALLS["data"][0], FILE, hostile)
    for part, name in (("data", FILE), ("ted", "ted/about.json"), ("ted", f"ted/{STEPS}")):
        for kind, damage in DAMAGE.items():
            if (name, kind) != (FILE, "missing"):  # then it is not there, which is right
                for words in CALLS[part]:
                    yield Fault(f"{name} {kind}", words, Path(name).name, at(part, name, damage))
    yield Fault(
        f"ted {STEPS} with a flipped bit", CALLS["ted"][0], f"{STEPS} .*changed", at("ted", f"ted/{STEPS}", flip)
    )
    for kind, damage in FORGERIES.items():
        yield Fault(f"ted {kind}", CALLS["ted"][0], f"{STEPS}|missing key", at("ted", f"ted/{STEPS}", forged(damage)))


@pytest.mark.parametrize("fault", table(faults()))
def test_damaged_demonstrations_are_named(fault, place):
    check(fault, meet(fault, place))
    assert not (place.root / "owned").exists()
