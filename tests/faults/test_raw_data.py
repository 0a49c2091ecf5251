# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests damage to every entry and file of raw demonstrations and data sets, and hostile files."""

import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_ledger import DAMAGE, Fault, Place, check, edit_json, flip, meet, table

from torchrl_koap.data.d3il.conversion import ROBOT_COLUMNS

FILE = "env_003_00.pkl"
VALIDATE = ("validate", "{data}")


def episode(rows: int = 30) -> dict[str, Any]:
    generator = np.random.default_rng(0)
    robot = {name: generator.normal(size=(rows, *shape)) for name, shape in ROBOT_COLUMNS.items()}
    return {"context": None, "robot": robot}


def written(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], None]:
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


# others are refused by tests/data/d3il/test_conversion.py
ARRAYS: dict[str, Callable[[np.ndarray], Any]] = {
    "None": lambda array: None,
    "text": lambda array: "n0nsense",
    "a number": lambda array: 3.5,
    "of truths": lambda array: array > 0,
    "longer": lambda array: np.concatenate([array, array[:1]]),
    "empty": lambda array: array[:0],
    "flat": lambda array: array.reshape(-1)[: 30 * 3].reshape(-1, 1, 1),
    "a scalar array": lambda array: np.float64(1.0),
}
NEEDED = ("des_c_pos", "c_pos")


class Hostile:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


HOSTILE = {  # all others are refused by tests/data/d3il/test_unpickling.py
    "system": pickle.dumps(Hostile(os.system, "touch owned")),
    "a script": b"import os\nos.system('touch owned')\n",
}
CONTENT: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a number": lambda content: 3,
    "robot None": lambda content: {"robot": None},
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


STEPS = "steps.safetensors"
ABOUT = {
    "task": (3, [1], "sorting", {"a": 1}),
    "sha256": (None, 3, {}, "0"),
    "definition": (3, "x", [1], {"name": 3}),
}


def ted() -> Iterator[Fault]:
    call = ("validate", "{ted}")
    train = ("train", "--out", "{out}", "--dataset", "{ted}", "--steps", "2", "--threads", "1")
    for name in ("about.json", STEPS):
        for kind, damage in DAMAGE.items():
            yield Fault(f"ted {name} {kind}", call, name, at(name, damage))
    yield Fault(f"ted {STEPS} with a flipped bit", call, f"{STEPS} .*changed", at(STEPS, flip))
    for name, values in ABOUT.items():
        for number, value in enumerate(values):
            damage = lambda path, n=name, v=value: edit_json(path, lambda about: about.update({n: v}))  # noqa: E731
            yield Fault(
                f"ted about.json {name} {number}",
                train if name == "definition" else call,
                "about.json|steps|task|ted",
                at("about.json", damage),
            )


def at(name: str, damage: Callable[[Path], object]) -> Callable[[Place], object]:
    return lambda place: damage(place.get("ted") / "ted" / name)


def faults() -> Iterator[Fault]:
    yield from raw()
    yield from ted()


@pytest.mark.parametrize("fault", table(faults()))
def test_damaged_demonstrations_are_named(fault, place):
    check(fault, meet(fault, place))
    assert not (place.root / "owned").exists()
