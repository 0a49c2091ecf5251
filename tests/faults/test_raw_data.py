# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw demonstrations and data sets on disk: every entry, every file, damaged in every way; and hostile ones."""

from __future__ import annotations

import json
import os
import pickle
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_damage import DAMAGE, flip
from fault_ledger import Fault, Place, check, edit_json, meet, table

from torchrl_koap.data.d3il.raw import ROBOT_COLUMNS

FILE = "env_003_00.pkl"
VALIDATE = ("validate", "{data}")


def episode(rows: int = 30) -> dict[str, Any]:
    """One demonstration with every entry that D3IL logs."""
    generator = np.random.default_rng(0)
    robot = {name: generator.normal(size=(rows, *shape)) for name, shape in ROBOT_COLUMNS.items()}
    return {"context": None, "robot": robot}


def written(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], None]:
    """Writes a demonstration after a change."""

    def do(place: Place) -> None:
        content = episode()
        other = change(content)
        (place.get("data") / FILE).write_bytes(pickle.dumps(content if other is None else other, protocol=4))

    return do


def raw_bytes(content: bytes) -> Callable[[Place], None]:
    return lambda place: (place.get("data") / FILE).write_bytes(content)


def put(name: str, make: Callable[[np.ndarray], Any]) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["robot"].update({name: make(content["robot"][name])})


def without(name: str) -> Callable[[dict[str, Any]], None]:
    def change(content):
        del content["robot"][name]

    return change


def with_value(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array):
        array = array.copy()
        array.reshape(-1)[-1] = value
        return array

    return change


ARRAYS: dict[str, Callable[[np.ndarray], Any]] = {
    "None": lambda array: None,
    "text": lambda array: "n0nsense",
    "a list": lambda array: array.tolist(),
    "a number": lambda array: 3.5,
    "of text": lambda array: array.astype("U8"),
    "complex": lambda array: array.astype(complex),
    "of truths": lambda array: array > 0,
    "NaN": with_value(np.nan),
    "infinite": with_value(-np.inf),
    "shorter": lambda array: array[:-1],
    "longer": lambda array: np.concatenate([array, array[:1]]),
    "empty": lambda array: array[:0],
    "wider": lambda array: np.stack([array, array, array, array, array], -1),
    "flat": lambda array: array.reshape(-1)[: 30 * 3].reshape(-1, 1, 1),
    "a scalar array": lambda array: np.float64(1.0),
}
NEEDED = ("des_c_pos", "c_pos")


class Hostile:
    """Runs a command when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def nested(depth: int) -> bytes:
    """A key that is a tuple of the same tuple twice, many times over: hashing it has no end."""
    made = b"".join(struct.pack("<cBcBccB", b"h", i, b"h", i, b"\x86", b"q", i + 1) for i in range(depth))
    return b"\x80\x02})q\x00" + made + b"K\x01s."


def colliding(number: int) -> bytes:
    """Keys with one hash; each is compared with all that came before."""
    keys = (pickle.encode_long(key * (2**61 - 1)) for key in range(number))
    return b"\x80\x02}(" + b"".join(b"\x8a" + bytes([len(key)]) + key + b"N" for key in keys) + b"u."


def deep(depth: int) -> bytes:
    return b"\x80\x02" + b"]" * depth + b"a" * (depth - 1) + b"."


HOSTILE = {
    "system": pickle.dumps(Hostile(os.system, "touch owned")),
    "eval": pickle.dumps(Hostile(eval, "open('owned', 'w')")),
    "exec": pickle.dumps(Hostile(exec, "open('owned', 'w')")),
    "getattr": pickle.dumps(Hostile(getattr, "a", "upper")),
    "open": pickle.dumps(Hostile(open, "owned", "w")),
    "print": pickle.dumps({"robot": print}),
    "a class": pickle.dumps({"robot": OrderedDict}),
    "a path": pickle.dumps({"robot": Path("x")}),
    "objects": pickle.dumps({"robot": {"c_pos": np.array([None, {}], dtype=object)}}),
    "numpy load": pickle.dumps(Hostile(np.load, "x")),
    "structured": pickle.dumps({"robot": {"c_pos": np.zeros(3, dtype=[("a", "f8")])}}),
    "dates": pickle.dumps({"robot": {"c_pos": np.zeros(3, dtype="datetime64[s]")}}),
    "nested keys": nested(40),
    "nested keys, deeper": nested(200),
    "colliding keys": colliding(60_000),
    "nested lists": deep(100_000),
    "nested lists, few": deep(70),
    "a slot beyond": b"\x80\x02Nr\xff\xff\xff\x7f.",
    "a persistent id": b"\x80\x02Pabc\n.",
    "an extension": b"\x80\x02\x82\x01.",
    "a frame beyond": b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7fN.",
    "bytes beyond": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7fa.",
    "text beyond": b"\x80\x02X\xff\xff\xff\x7fa.",
    "a long beyond": b"\x80\x02\x8b\xff\xff\xff\x7f\x01.",
    "two pickles": pickle.dumps(episode()) * 2,
    "a tail": pickle.dumps(episode()) + b"tail",
    "only a mark": b"(.",
    "no stop": b"\x80\x04N",
    "a stop": b".",
    "zeros": bytes(1000),
    "a picture": b"\x89PNG\r\n\x1a\n" + bytes(500),
    "an archive": b"PK\x03\x04" + bytes(500),
    "a script": b"import os\nos.system('touch owned')\n",
    "numpy's own format": b"\x93NUMPY\x01\x00" + bytes(200),
    "protocol 255": b"\x80\xff.",
}
CONTENT: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a list": lambda content: [content],
    "a number": lambda content: 3,
    "nothing": lambda content: {},
    "no robot": lambda content: {"context": None},
    "robot a list": lambda content: {"robot": [1]},
    "robot None": lambda content: {"robot": None},
    "robot empty": lambda content: {"robot": {}},
    "robot of other names": lambda content: {"robot": {"xyz": np.zeros((30, 3))}},
    "robot of numbers": lambda content: {"robot": {1: np.zeros((30, 3))}},
    "one row": lambda content: {"robot": {name: array[:1] for name, array in content["robot"].items()}},
    "no rows": lambda content: {"robot": {name: array[:0] for name, array in content["robot"].items()}},
    "an object of another task": lambda content: content.update(
        {"push-box": {"pos": np.zeros((30, 3)), "quat": np.zeros((30, 4))}}
    ),
    "an object that is none": lambda content: content.update({"push-box": 3}),
}


def raw() -> Iterator[Fault]:
    for name in ROBOT_COLUMNS:
        for kind, make in ARRAYS.items():
            yield Fault(f"{name} {kind}", VALIDATE, FILE, written(put(name, make)))
    for name in NEEDED:
        yield Fault(f"{name} missing", VALIDATE, f"{FILE}.*{name}", written(without(name)))
    for kind, content in HOSTILE.items():
        yield Fault(f"hostile {kind}", VALIDATE, FILE, raw_bytes(content))
    for kind, change in CONTENT.items():
        yield Fault(f"content {kind}", VALIDATE, FILE, written(change))
    for kind, damage in DAMAGE.items():
        if kind != "missing":
            yield Fault(f"{FILE} {kind}", VALIDATE, FILE, lambda place, d=damage: d(place.get("data") / FILE))
            yield Fault(
                f"{FILE} {kind}",
                ("train", "--out", "{out}", "--dataset", "{data}", "--steps", "2"),
                FILE,
                lambda place, d=damage: d(place.get("data") / FILE),
            )


ABOUT = {
    "format": (2, None, "1", [1]),
    "task": (3, [1], "sorting", {"a": 1}),
    "sha256": (None, 3, {}, {"steps/meta.json": "0"}),
    "definition": (3, "x", [1], {"name": 3}),
}


def ted() -> Iterator[Fault]:
    call = ("validate", "{ted}")
    train = ("train", "--out", "{out}", "--dataset", "{ted}", "--steps", "2", "--threads", "1")
    files = ("about.json", "steps/meta.json", "steps/action.memmap", "steps/next/meta.json", "steps/next/done.memmap")
    for name in files:
        for kind, damage in DAMAGE.items():
            yield Fault(f"ted {name} {kind}", call, name.split("/")[-1], at(name, damage))
    for name in (
        "steps/action.memmap",
        "steps/observation.memmap",
        "steps/episode.memmap",
        "steps/next/observation.memmap",
    ):
        yield Fault(f"ted {name} with a flipped bit", call, name, at(name, flip))
    for name, values in ABOUT.items():
        for number, value in enumerate(values):
            damage = lambda path, n=name, v=value: edit_json(path, lambda about: about.update({n: v}))  # noqa: E731
            yield Fault(
                f"ted about.json {name} {number}",
                train if name == "definition" else call,
                "about.json|steps|task|ted",
                at("about.json", damage),
            )
    outside = {
        "a link": lambda steps: link(steps / "action.memmap"),
        "a folder that is a link": link_folder,
        "an entry above": lambda steps: rename(steps, "action", "../action"),
        "an entry further above": lambda steps: rename(steps, "action", "../../../secret"),
        "an absolute entry": lambda steps: rename(steps, "action", "/etc/passwd"),
        "an entry of another kind": lambda steps: set_entry(steps, "action", {"type": "NonTensorData"}),
        "another class": lambda steps: set_entry(steps, "_type", "<class 'os.system'>"),
        "a longer shape": lambda steps: set_entry(steps, "action", {"dtype": "torch.float32", "shape": [10**9, 2]}),
        "a negative shape": lambda steps: set_entry(steps, "action", {"dtype": "torch.float32", "shape": [-1, 2]}),
        "no element type": lambda steps: set_entry(steps, "action", {"dtype": "torch.nothing", "shape": [3, 2]}),
        "a wider element type": lambda steps: set_entry(
            steps, "action", {"device": "cpu", "dtype": "torch.float64", "shape": [268, 2], "is_nested": False}
        ),
    }
    for kind, damage in outside.items():
        yield Fault(f"ted {kind}", call, "steps", forged(damage))


def at(name: str, damage: Callable[[Path], object]) -> Callable[[Place], object]:
    return lambda place: damage(place.get("ted") / "ted" / name)


def link(path: Path) -> None:
    target = path.parents[3] / "secret"
    target.write_bytes(path.read_bytes())
    path.unlink()
    path.symlink_to(target)


def link_folder(steps: Path) -> None:
    target = steps.parents[2] / "elsewhere"
    (steps / "next").rename(target)
    (steps / "next").symlink_to(target)


def rename(steps: Path, old: str, new: str) -> None:
    edit_json(steps / "meta.json", lambda meta: meta.update({new: meta.pop(old)}))


def set_entry(steps: Path, name: str, value: Any) -> None:
    edit_json(steps / "meta.json", lambda meta: meta.update({name: value}))


def forged(damage: Callable[[Path], object]) -> Callable[[Place], None]:
    """Damage by somebody who has made the checksums fit."""

    def do(place: Place) -> None:
        from torchrl_koap.data import ted

        folder = place.get("ted") / "ted"
        damage(folder / "steps")
        about = json.loads((folder / "about.json").read_text())
        about["sha256"] = ted._checksums(folder)
        (folder / "about.json").write_text(json.dumps(about))

    return do


def faults() -> Iterator[Fault]:
    yield from raw()
    yield from ted()


@pytest.mark.parametrize("fault", table(faults()))
def test_damaged_demonstrations_are_named(fault, place):
    check(fault, meet(fault, place))
    assert not (place.root / "owned").exists()
