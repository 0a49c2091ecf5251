# This source code is licensed under the MIT license found in the LICENSE file.
"""Defines faults of a user and the error messages that they must give; one fault is one line of a test table.

Each fault calls ``koap`` in this process. The call must end with status 1 and one line, or with 2 and the name of the
option. A call that reaches the work itself (training, rollouts) counts as accepted and is stopped there, so that
hundreds of faults take seconds.
"""

import contextlib
import io
import json
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import TINY, koap, write_demonstrations

LONGEST = 60  # s; a fault that takes longer counts as a hang
EVERY = 25  # `make test` runs one of this many faults, `make faults` all of them
# functions with which the work of a command begins
WORK = (
    "torchrl_koap.training.loop.warmup_cosine",
    "torchrl_koap.evaluation.closed_loop.roll_out",
    "torchrl_koap.evaluation.inspection.roll_out",
    "torchrl_koap.studies.run.launch",
    "torchrl_koap.commands.run_commands.export_policy",
    "torchrl_koap.data.demonstrations.save_ted",
)
# a valid call of `koap embed` that needs no weights of an extra
EMBED = (
    *("{frames}", "--task", "scooping", "--out", "{out}", "--network", "tiny_network:random_layer"),
    *("--projection", "{network}/projection.safetensors"),
)


class AcceptedError(BaseException):
    """Raised when the work begins."""


class HangError(BaseException):
    """Raised when a call takes longer than :data:`LONGEST`."""


@dataclass(frozen=True)
class Place:
    """Folders of one fault below an empty ``root``, copied from a ``template`` that is never written to."""

    root: Path
    template: Path

    def get(self, name: str) -> Path:
        """Returns a copy of a part of the template, or a path that does not exist."""
        path, source = self.root / name, self.template / name
        if source.exists() and not path.exists():
            shutil.copytree(source, path)
        return path


@dataclass(frozen=True)
class Fault:
    """A call, the damage before it, the pattern of its error line and its exit status.

    In its words ``{run}``, ``{data}``, ``{ted}``, ``{arrays}``, ``{filmed}``, ``{frames}`` and ``{network}`` stand for
    folders of the template, ``{out}`` for a new one. With ``accepted`` the call must be accepted.
    """

    name: str
    words: tuple[str, ...]
    says: str = ""
    damage: Callable[[Place], Any] | None = None
    status: int | tuple[int, ...] = 1
    accepted: bool = False

    @property
    def id(self) -> str:
        return re.sub(r"[^\w.=+-]+", "_", f"{self.words[0]} {self.name}")[:100]


@dataclass(frozen=True)
class Outcome:
    """Result of a call: its exit status, ``"accepted"``, ``"hang"`` or the escaped error; and its error output."""

    status: Any
    said: str


def meet(fault: Fault, place: Place) -> Outcome:
    """Does the damage, makes the call and returns its outcome."""
    words = [_filled(word, place) for word in fault.words]
    if fault.damage is not None:
        fault.damage(place)
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()), stopped_at_work(), _in_time():
        try:
            status = koap(*words)
        except AcceptedError:
            status = "accepted"
        except HangError:
            status = "hang"
        except SystemExit as left:
            status = left.code
        except Exception as error:  # what a user would see as a traceback
            status = f"{type(error).__name__}: {error}"
    return Outcome(status, said.getvalue())


def check(fault: Fault, outcome: Outcome) -> None:
    details = f"{fault.id}: status {outcome.status}, said {outcome.said[-500:]!r}"
    if fault.accepted:
        assert outcome.status in (0, "accepted"), details
        return
    wanted = fault.status if isinstance(fault.status, tuple) else (fault.status,)
    assert outcome.status in wanted, details
    assert "Traceback" not in outcome.said, details
    if outcome.status == 2:  # the parser frames what it says
        plain = re.sub(r"[│╭╮╰╯─\s]+", " ", outcome.said)
    else:
        lines = [line for line in outcome.said.replace("\r", "\n").splitlines() if line.startswith("koap: ")]
        assert len(lines) == 1 and outcome.said.rstrip().endswith(lines[0]), details
        plain = lines[0]
    assert re.search(fault.says, plain), f"{details}\nwanted {fault.says!r}"


def table(faults: Iterable[Fault], every: int = EVERY) -> list[Any]:
    """Returns one test parameter per fault; most of them run only in ``make faults``."""
    faults = list(faults)
    names = [fault.id for fault in faults]
    assert len(set(names)) == len(names), f"twice: {sorted({name for name in names if names.count(name) > 1})}"
    return [
        pytest.param(fault, id=fault.id, marks=() if index % every == every // 2 else pytest.mark.faults)
        for index, fault in enumerate(faults)
    ]


def make_template(root: Path) -> Path:
    """Makes a trained run with checkpoints and data of every kind."""
    import numpy as np

    from torchrl_koap.data import open_dataset, save_ted
    from torchrl_koap.tasks import get_task

    data = write_demonstrations(root / "data")
    run = ("--out", root / "run", "--dataset", data, *TINY, "--quiet")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchrl_koap.training.loop.CHECKPOINT_EVERY", 10)
        assert koap("train", *run) == 0
    flat = open_dataset(data, task=get_task("avoiding"))[0]
    save_ted(flat, root / "ted" / "ted", get_task("avoiding"))
    (root / "arrays").mkdir()
    for index in range(3):
        generator = np.random.default_rng(index)
        states = generator.normal(size=(40, 3)).cumsum(0)
        np.savez(root / "arrays" / f"{index}.npz", states=states, actions=np.diff(states[:, :2], axis=0))
    make_camera_template(root)
    return root


def make_camera_template(root: Path) -> None:
    """Makes demonstrations with cameras, and a projection for a custom network."""
    import numpy as np
    import torch
    from camera_sets import write_camera_set

    from torchrl_koap.data.formats.writers import encode_png
    from torchrl_koap.tasks import get_task
    from torchrl_koap.vision import FrozenImageEncoder, Projection, load_backbone

    write_camera_set(root / "frames", "robot")
    generator = np.random.default_rng(0)
    for number in range(2):  # recordings with two cameras beside them
        states = generator.normal(size=(20, 2)).cumsum(0)
        (root / "filmed" / str(number) / "top").mkdir(parents=True)
        np.savez(root / "filmed" / f"{number}.npz", states=states, actions=np.diff(states, axis=0), control_hz=10.0)
        frames = generator.integers(0, 256, (20, 8, 8, 3), dtype=np.uint8)
        np.save(root / "filmed" / str(number) / "wrist.npy", frames)
        for index, frame in enumerate(frames):
            (root / "filmed" / str(number) / "top" / f"{index:06d}.png").write_bytes(encode_png(frame))
    torch.manual_seed(0)
    about = FrozenImageEncoder(load_backbone("tiny_network:random_layer"), size=8).identity
    fitted = Projection(torch.zeros(40), torch.randn(40, get_task("scooping").observation_dim - 3), about)
    (root / "network").mkdir()
    fitted.save(root / "network" / "projection.safetensors")


@contextlib.contextmanager
def stopped_at_work() -> Iterator[None]:
    """Raises :class:`AcceptedError` when work begins inside the block."""

    def stop(*arguments, **options):
        raise AcceptedError

    with pytest.MonkeyPatch.context() as patch:
        for place in WORK:
            patch.setattr(place, stop)
        yield


@contextlib.contextmanager
def _in_time() -> Iterator[None]:
    def late(*arguments):
        raise HangError

    earlier = signal.signal(signal.SIGALRM, late)
    signal.alarm(LONGEST)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, earlier)


def _filled(word: str, place: Place) -> str:
    for name in ("run", "data", "ted", "arrays", "filmed", "seen", "frames", "network", "out"):
        if f"{{{name}}}" in word:
            word = word.replace(f"{{{name}}}", str(place.get(name)))
    return word


def edit_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-9] ^= 4
    path.write_bytes(content)


def grow(path: Path) -> None:
    """Grows a file beyond any memory; the file is sparse."""
    with path.open("r+b") as file:
        file.truncate(40 << 30)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def zeros(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


# damage to any file
DAMAGE: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "cut by a byte": lambda path: os.truncate(path, path.stat().st_size - 3),
    "of noise": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "of another kind": lambda path: path.write_text("just words\n" * 30),
    "a folder": folder,
    "a pipe": pipe,
    "without end": zeros,
    "of 40 GB": grow,
}
