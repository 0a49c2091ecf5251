# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests ``koap embed`` on damaged camera demonstrations, networks and projections."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fault_ledger import DAMAGE, Fault, Place, check, edit_json, meet, table
from fault_ledger import EMBED as WORDS

pytest.importorskip("pyarrow")

EMBED = ("embed", *WORDS)
INFO, FIRST = "meta/info.json", "data/chunk-000/file-000.parquet"
PROJECTION = "projection.safetensors"


def damaged(part: str, file: str, damage: Callable[[Path], object]) -> Callable[[Place], None]:
    return lambda place: damage(place.get(part) / file) and None


def info(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], None]:
    return lambda place: edit_json(place.get("frames") / INFO, change)


def columns(change: Callable[[dict[str, Any]], Any]) -> Callable[[Place], None]:
    """Rewrites the first episode after a change of its columns."""

    def do(place: Place) -> None:
        import pyarrow
        from pyarrow import parquet

        file = place.get("frames") / FIRST
        read = parquet.read_table(file)
        content = {name: read[name].to_pylist() for name in read.column_names}
        change(content)
        parquet.write_table(pyarrow.table(content), file)

    return do


def without(name: str) -> Callable[[dict[str, Any]], Any]:
    return lambda content: content.pop(name)


def put(name: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda content: content.update({name: value})


def cell(name: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda content: content[name].__setitem__(0, value)


def projection(change: Callable[[dict[str, Any], dict[str, str]], Any]) -> Callable[[Place], None]:
    """Rewrites the projection after a change of its tensors and its description."""

    def do(place: Place) -> None:
        from safetensors import safe_open
        from safetensors.torch import save_file

        path = place.get("network") / PROJECTION
        with safe_open(str(path), "pt") as file:
            tensors, about = {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())
        change(tensors, about)
        save_file(tensors, path, about)

    return do


def _png(size: int, channels: int = 3) -> bytes:
    import numpy as np

    from torchrl_koap.data.formats.writers import encode_png

    return encode_png(np.zeros((size, size, channels), dtype=np.uint8))


def first(rows: int) -> Callable[[dict[str, Any]], Any]:
    return lambda content: [content.update({name: content[name][:rows]}) for name in content]


CAMERA, STATE = "observation.images.third_person", "observation.state"
# of the first episode: what is wrong, what is said, and the change
EPISODE = {
    "frames of no picture": ("picture|image", cell(CAMERA, {"bytes": b"PNG", "path": None})),
    "frames of no bytes": ("picture|image", cell(CAMERA, {"bytes": None, "path": "x.png"})),
    "frames of another size": ("size|shape", cell(CAMERA, {"bytes": _png(16), "path": ""})),
    "frames with alpha": ("shape|colours", cell(CAMERA, {"bytes": _png(8, 4), "path": ""})),
    "state of another width": (STATE, cell(STATE, [1.0])),
    "state is NaN": ("not finite", cell(STATE, [float("nan")] * 3)),
    "state is text": (STATE, put(STATE, ["x"] * 7)),
    "action of another width": ("action", cell("action", [1.0])),
    "action is infinite": ("infinite|NaN", cell("action", [float("inf")] * 7)),
    "one row": ("row|frame", first(1)),
    "no rows": ("row|frame", first(0)),
}
for _name in (CAMERA, STATE):
    EPISODE |= {
        f"episode without {_name}": (_name, without(_name)),
        f"{_name} is null": (f"{_name}|not finite", cell(_name, None)),
    }


CONVERT = ("convert", "{filmed}", "--out", "{out}")
SEEN = ("embed", "{seen}", "--out", "{out}", "--network", "tiny_network:random_layer", "--components", "3")
TOP, WRIST = "1/top/000007.png", "1/wrist.npy"


# frames beside own arrays: what is said where they are converted, and where they are embedded after it; the damage
FILMED: dict[str, tuple[str | None, str, Callable[[Path], Any]]] = {
    "a frame missing": (
        "1.npz.*'top': frame 7 is missing",
        "'top' of 1.*frame 7 is missing",
        lambda folder: (folder / TOP).unlink(),
    ),
    "a camera absent": (
        "'wrist' has no frames in 1.npz",
        r"wrist.npy is missing",
        lambda folder: (folder / WRIST).unlink(),
    ),
    "no array": (*("wrist.npy holds no array of numbers",) * 2, lambda folder: (folder / WRIST).write_bytes(b"array")),
    "a damaged picture": (
        None,
        "'top' of 1.*frame 7 .000007.png. is no readable image",
        lambda folder: (folder / TOP).write_bytes(b"PNG"),
    ),
}


def filmed(damage: Callable[[Path], Any]) -> Callable[[Place], None]:
    return lambda place: damage(place.get("filmed")) and None


def seen(damage: Callable[[Path], Any]) -> Callable[[Place], None]:
    def do(place: Place) -> None:
        from torchrl_koap.data import read_recordings, save_demonstrations

        save_demonstrations(place.get("seen"), read_recordings(place.get("filmed")))
        damage(place.get("filmed"))

    return do


def in_projection() -> Iterator[tuple[str, str, Callable[[dict[str, Any], dict[str, str]], Any]]]:
    """What is wrong, what is said, and the change of tensors and description."""
    yield "of other weights", "other|fitted", lambda _, about: about.update(weights="0" * 64)
    for name in ("weights", "size"):
        yield f"without {name}", name, lambda _, about, n=name: about.pop(n)
    yield "size -1", "size|frames must be", lambda _, about: about.update(size="-1")
    yield "size empty", r"size|projection\.safetensors", lambda _, about: about.update(size="")
    for name in ("mean", "components"):
        yield f"without {name}", name, lambda held, _, n=name: held.pop(n)
        yield f"{name} cut", "mean|features", lambda held, _, n=name: held.update({n: held[n][:9].clone()})
        yield f"{name} NaN", "NaN", lambda held, _, n=name: held[n].fill_(float("nan"))


def faults() -> Iterator[Fault]:
    for name, damage in DAMAGE.items():
        for part, file in (("frames", INFO), ("frames", FIRST), ("network", PROJECTION)):
            stem = Path(file).name
            says = "episodes are missing: 0" if (file, name) == (FIRST, "missing") else stem.replace(".", r"\.")
            yield Fault(f"{stem} {name}", EMBED, says, damaged(part, file, damage))
    for name in ("codebase_version", "data_path", "total_episodes"):
        yield Fault(f"info.json without {name}", EMBED, damage=info(without(name)), accepted=True)
    yield Fault("info.json without features", EMBED, "feature", info(without("features")))
    for name, value in {"a list": [], "empty": {}, "null": None, "3": 3, "blind": {STATE: {}}}.items():
        yield Fault(f"features {name}", EMBED, "camera|feature", info(put("features", value)))
    for name, (says, change) in EPISODE.items():
        yield Fault(name, EMBED, says, columns(change))
    for name, (early, late, damage) in FILMED.items():
        says = {} if early is None else {"says": early}
        yield Fault(f"filmed {name}", CONVERT, damage=filmed(damage), accepted=early is None, **says)
        yield Fault(f"seen {name}", SEEN, late, seen(damage))
    yield Fault("seen nothing wrong", SEEN, damage=seen(lambda folder: None), accepted=True)
    unharmed = seen(lambda folder: None)
    yield Fault("another camera", (*SEEN, "--camera", "tip"), "unknown camera 'tip'; did you mean 'top'", unharmed)
    yield Fault("too many components", (*SEEN[:-1], "99"), "--components.* must be below frames", unharmed)
    for name, says, change in in_projection():
        yield Fault(f"projection {name}", EMBED, says, projection(change))


@pytest.mark.parametrize("fault", table(faults(), every=8))
def test_damaged_camera_data_are_refused_by_name(fault, place):
    check(fault, meet(fault, place))
