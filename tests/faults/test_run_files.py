# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests damage to every file of a run, and values of another type for every entry of its options."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from fault_ledger import DAMAGE, Fault, Place, check, edit_json, flip, meet, table
from safetensors.torch import save_file

from torchrl_koap.runs.weights import load_tensors, save_tensors

JSON = ("config.json",)
WEIGHTS = ("planner.safetensors", "controller.safetensors")
STATES = ("checkpoints/planner.safetensors", "checkpoints/controller.safetensors")
EVAL = ("eval", "{run}", "--episodes", "1", "--threads", "1", "--no-report")
RESUME = ("train", "--out", "{run}", "--resume")
READERS = {
    "eval": EVAL,
    "export": ("export", "{run}"),
    "suggest": ("suggest", "{run}"),
    "inspect": ("inspect", "{run}", "--episodes", "1", "--threads", "1"),
    "latency": ("latency", "{run}", "--steps", "2"),
    "doctor": ("doctor", "{run}"),
}


def damaged(name: str, damage: Callable[[Path], object], *, finished: bool = True) -> Callable[[Place], None]:
    def do(place: Place) -> None:
        run = place.get("run")
        if not finished:  # to be resumed from the checkpoint of its last phase
            (run / "controller.safetensors").unlink()
            if "planner" in name:
                (run / "planner.safetensors").unlink()
        damage(run / name)

    return do


def entry(path: str, value: object) -> Callable[[Place], None]:
    def do(place: Place) -> None:
        def change(content):
            *above, last = path.split(".")
            for name in above:
                content = content[name]
            content[last] = value

        edit_json(place.get("run") / "config.json", change)

    return do


def tensors(name: str, change: Callable, *, finished: bool = True, digest: bool = True) -> Callable[[Place], None]:
    """Changes tensors and facts of a file, and its checksum with them or not."""

    def do(place: Place) -> None:
        def rewrite(path):
            held, about = load_tensors(path)
            change(held, about)
            if digest:
                save_tensors(path, held, about)
            else:
                save_file(held, path, metadata={"about": json.dumps(about)})

        damaged(name, rewrite, finished=finished)(place)

    return do


def put(key: str, value: object) -> Callable:
    return lambda held, about: about.update({key: value})


def drop(part: str) -> Callable:
    def change(held, about):
        for name in [name for name in held if part in name]:
            del held[name]

    return change


def apply(part: str, function: Callable) -> Callable:
    def change(held, about):
        names = [name for name in held if part in name]
        assert names
        for name in names:
            held[name] = function(held[name])

    return change


def files() -> Iterator[Fault]:
    for kind, damage in DAMAGE.items():
        for name in (*JSON, *WEIGHTS):
            for words in READERS.values():
                yield Fault(f"{name} {kind}", words, name, damaged(name, damage))
        if kind != "missing":  # then they are not there, which is right
            for name in STATES:
                yield Fault(f"{name} {kind}", READERS["doctor"], name, damaged(name, damage))
                yield Fault(f"resume {name} {kind}", RESUME, name, damaged(name, damage, finished=False))
        yield Fault(
            f"resume config.json {kind}", RESUME, "config.json|--dataset|demonstrations", damaged("config.json", damage)
        )
    for name in (*WEIGHTS, *STATES):
        yield Fault(f"{name} with a flipped bit", READERS["doctor"], name, damaged(name, flip))
    for name in WEIGHTS:
        yield Fault(f"{name} with a flipped bit", EVAL, name, damaged(name, flip))
    for name in STATES:
        yield Fault(f"resume {name} with a flipped bit", RESUME, name, damaged(name, flip, finished=False))
    for kind in ("of noise", "a pipe", "without end", "of 40 GB", "of another kind"):
        yield Fault(f"metrics.csv {kind}", READERS["doctor"], "metrics.csv", damaged("metrics.csv", DAMAGE[kind]))
        yield Fault(f"summary.json {kind}", READERS["doctor"], "summary.json", damaged("summary.json", DAMAGE[kind]))


TYPES = {"null": None, "text": "n0nsense", "a fraction": 8.5, "a list": [[]], "an object": {"a": 1}, "true": True}
# entries of config.json that build the networks, and the kinds of values that would do
ENTRIES = {
    "method": (),
    "planner": (),
    "labels": (),
    "planner.network": (),
    "planner.frames": (),
    "controller.columns": (),
    "labels.fraction": ("null",),
    "labels.episodes": (),
    "planner.learning_rate": ("null", "a fraction"),
    "run.plugins": (),
    "execution.strategy": ("null",),
}


def entries() -> Iterator[Fault]:
    """Values of another kind are found out by their type, others by what they mean."""
    for path, right in ENTRIES.items():
        for kind, value in TYPES.items():
            if kind not in right:
                yield Fault(f"config.json {path} is {kind}", EVAL, "config.json|task|does not fit", entry(path, value))
    for reader in (EVAL, READERS["doctor"]):
        yield Fault("config.json names another width", reader, "planner.width 8, not on 16", entry("planner.width", 16))
    yield Fault("config.json NaN", EVAL, "config.json", entry("planner.learning_rate", float("nan")))
    yield Fault("config.json infinite", EVAL, "config.json", entry("planner.learning_rate", float("inf")))
    yield Fault("config.json beyond 64 bits", EVAL, "config.json", entry("planner.frames", 10**40))
    yield Fault("config.json names a module", EVAL, "no_such_module", entry("run.plugins", ["no_such_module"]))


def contents() -> Iterator[Fault]:
    """Weights and training states that were written whole, and are wrong."""
    nan = lambda value: torch.full_like(value, torch.nan)  # noqa: E731
    for name in WEIGHTS:
        normaliser = "plan_normalizer" if "planner" in name else "action_normalizer"
        wrong = {
            "another task": put("task", "sorting"),
            "no task": put("task", None),
            "no normaliser": drop(normaliser),
            "other shapes": apply("weight", lambda value: value[:1].clone()),
            "nothing": drop(""),
        }
        for kind, change in wrong.items():
            yield Fault(f"{name} {kind}", EVAL, name, tensors(name, change))
            yield Fault(f"{name} {kind}", READERS["doctor"], name, tensors(name, change))
        damaged = {  # the checksum vouches for the numbers
            "weights NaN": apply("weight", nan),
            "negative scale": apply(f"{normaliser}.scale", lambda value: -value),
            "scale zero": apply(f"{normaliser}.scale", lambda value: 0 * value),
            "offset NaN": apply(f"{normaliser}.offset", nan),
        }
        for kind, change in (wrong | damaged).items():
            yield Fault(f"{name} {kind} of before", EVAL, name, tensors(name, change, digest=False))
    for name in STATES:
        wrong = {
            "step huge": put("step", 10**9),
            "no optimiser": drop("optimizer."),
            "no first moments": drop(".exp_avg"),
            "moments of other shapes": apply(".exp_avg_sq", lambda value: value.reshape(-1)[:1].clone()),
            "no random state": drop("rng.cpu"),
            "random state cut": apply("rng.cpu", lambda value: value[:7].clone()),
            "random state of floats": apply("rng.cpu", lambda value: value.float()),
            "no network": drop("loss."),
            "network of doubles": apply("loss.", lambda value: value.double()),
            "network cut": apply("loss.", lambda value: value.reshape(-1)[:1].clone()),
        }
        for kind, change in wrong.items():
            yield Fault(f"{name} {kind}", RESUME, name, tensors(name, change, finished=False))
        unseen = {"step negative": put("step", -5), "moments NaN": apply(".exp_avg_sq", nan)}
        for kind, change in (wrong | unseen).items():
            yield Fault(f"{name} {kind} of before", RESUME, name, tensors(name, change, finished=False, digest=False))


def faults() -> Iterator[Fault]:
    yield from files()
    yield from entries()
    yield from contents()


@pytest.mark.parametrize("fault", table(faults()))
def test_a_damaged_run_is_named(fault, place):
    check(fault, meet(fault, place))
