# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording into a folder: episodes are written as they come, interruptions cost nothing, nothing is overwritten."""

from __future__ import annotations

import json

import pytest

from torchrl_koap.data.ted import load_ted, read_about
from torchrl_koap.envs.experts import demonstration_folder
from torchrl_koap.envs.experts.demonstration_folder import record_to_folder
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.tasks import get_task

TASK = get_task("avoiding")
COUNT = 3


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "demos"
    return folder, record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1)


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_data_are_those_of_a_recording_in_memory(whole):
    folder, report = whole
    data, again = record_demonstrations("avoiding", COUNT, seed=3, num_threads=1)
    assert (load_ted(folder / "ted")[0] == data).all()
    assert (report.each("mode"), report.each("rows"), report.each("attempts")) == (
        again.each("mode"),
        again.each("rows"),
        again.each("attempts"),
    )
    assert [path.name for path in folder.iterdir()] == ["ted"]
    notes = read_about(folder / "ted")["notes"]
    assert notes["seed"] == 3 and notes["modes"] == report.each("mode") and notes["attempts"] == report.each("attempts")


class Stop(Exception):
    pass


def interrupt_after(monkeypatch, number):
    """Ends a recording, as a signal would, once ``number`` demonstrations are there; returns those asked for."""
    iterate = demonstration_folder.iterate_takes
    asked = []

    def some(*arguments, done=(), **options):
        asked.append(sorted(done))
        for count, take in enumerate(iterate(*arguments, done=done, **options)):
            if count == number:
                raise Stop
            yield take

    monkeypatch.setattr(demonstration_folder, "iterate_takes", some)
    return asked


def test_an_interrupted_recording_goes_on(whole, tmp_path, monkeypatch):
    folder = tmp_path / "demos"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.raises(Stop):
            record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1, batch_size=3)
    # files are there before the recording is over
    assert len(list((folder / "unfinished").glob("*.npz"))) == 2 and not (folder / "ted").exists()
    asked, calls = interrupt_after(monkeypatch, 99), []
    record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1, progress=lambda done, total: calls.append(done))
    assert asked[-1] == [0, 1] and calls[0] == 2 and calls[-1] == COUNT and calls == sorted(calls)
    assert contents(folder) == contents(whole[0])


def test_an_interruption_at_the_very_end_is_made_good(whole, tmp_path, monkeypatch):
    folder = tmp_path / "demos"

    def fail(*arguments, **options):
        raise Stop

    with monkeypatch.context() as patch:
        patch.setattr(demonstration_folder, "save_ted", fail)
        with pytest.raises(Stop):
            record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1)
    assert not (folder / "ted").exists()
    record_to_folder(folder, TASK, COUNT, seed=3, num_threads=1)
    assert contents(folder) == contents(whole[0])


def test_other_demonstrations_are_left_alone(whole, tmp_path, monkeypatch):
    before = contents(whole[0])
    with pytest.raises(FileExistsError, match="ted exists already; choose another --out"):
        record_to_folder(whole[0], TASK, COUNT, seed=3)
    assert contents(whole[0]) == before
    interrupt_after(monkeypatch, 1)
    with pytest.raises(Stop):
        record_to_folder(tmp_path, TASK, COUNT, seed=3, num_threads=1, batch_size=1)
    with pytest.raises(FileExistsError, match="interrupted recording with seed 3, not 4, disturbance 0.0, not 0.5"):
        record_to_folder(tmp_path, TASK, COUNT, seed=4, disturbance=0.5)
    assert json.loads((tmp_path / "unfinished" / "request.json").read_text())["seed"] == 3


def test_nothing_is_written_for_wrong_arguments(tmp_path):
    with pytest.raises(ValueError, match="episodes must be an integer of at least 1, got 0"):
        record_to_folder(tmp_path / "demos", TASK, 0)
    with pytest.raises(ValueError, match="0 to 1, got 2"):
        record_to_folder(tmp_path / "demos", TASK, 2, disturbance=2)
    assert not (tmp_path / "demos").exists()
