# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the registry of pictures, also with pictures from outside the package."""

import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from run_files import write_run

from torchrl_koap.reports import pictures
from torchrl_koap.reports.pictures import NothingToDraw, all_pictures, draw_pictures, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.run_report import write_report

PICTURES = all_pictures()


@pytest.fixture(autouse=True)
def register(monkeypatch):
    """A few pictures, which are drawn fast; what a test registers is forgotten afterwards."""
    few = ("modes.png", "losses.png", "rollouts.gif")
    monkeypatch.setattr(pictures, "_PICTURES", {name: PICTURES[name] for name in few})


def test_one_decorated_function_is_a_picture_of_the_report(tmp_path):
    @picture("speed.png", source="rollouts.safetensors", title="How fast <it> is", caption="Metres per step & more.")
    def draw_speed(rollouts, run):
        assert (rollouts["position"].ndim, round(run.control_hz, 1), run.modes.number) == (3, 28.6, 24)
        return Figure()

    page = write_report(write_run(tmp_path), animation=False).read_text()
    assert (tmp_path / "plots" / "speed.png").exists() and 'src="plots/speed.png"' in page
    assert "How fast &lt;it&gt; is" in page and "Metres per step &amp; more." in page


def test_a_second_picture_of_the_same_name_is_an_error():
    def mine(rollouts, run): ...

    with pytest.raises(ValueError, match=r"'modes.png' is registered already, by torchrl_koap.*draw_modes; .*mine"):
        picture("modes.png", source="rollouts.safetensors", title="", caption="")(mine)


def test_a_failure_is_told_and_the_others_are_drawn(tmp_path):
    @picture("broken.png", source="eval.json", title="Broken", caption="")
    def draw(evaluation, run):
        raise ValueError(f"no entry in {len(evaluation)}")

    problems = draw_pictures(write_run(tmp_path), animation=False)
    assert list(problems) == ["broken.png"] and problems["broken.png"].startswith("eval.json: no entry in ")
    assert (tmp_path / "plots" / "modes.png").exists()


def test_nothing_to_draw_removes_an_earlier_picture(tmp_path):
    @picture("none.png", source="eval.json", title="None", caption="", empty="the evaluation is short")
    def draw(evaluation, run):
        raise NothingToDraw

    run = write_run(tmp_path)
    (run / "plots").mkdir()
    (run / "plots" / "none.png").write_bytes(b"of earlier data")
    assert draw_pictures(run, animation=False) == {} and not (run / "plots" / "none.png").exists()
    assert "None: not drawn, the evaluation is short." in write_report(run, draw=False).read_text()


def test_films_keep_colours_that_are_in_a_few_frames_only(tmp_path):
    frames = np.full((60, 9, 9, 3), 255, np.uint8)
    frames[:, :2, :2] = 10, 127, 127
    frames[12:24, 4:7, 4:7] = 41, 106, 204
    pictures.save_film(pictures.Film(frames, 0.1), tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        film.seek(1)  # equal neighbours are one frame
        assert film.convert("RGB").getpixel((5, 5)) == (41, 106, 204)


@pytest.mark.parametrize(("age", "stays"), [(-10, False), (10, True)])
def test_films_of_an_earlier_evaluation_do_not_stay_beside_the_figures_of_another(age, stays, tmp_path):
    run = write_run(tmp_path)
    (run / "plots").mkdir()
    film, source = run / "plots" / "rollouts.gif", run / all_pictures()["rollouts.gif"].source
    source.touch()
    film.write_bytes(b"film")
    os.utime(film, (source.stat().st_mtime + age,) * 2)
    draw_pictures(run, animation=False)
    assert film.exists() == stays


def test_pictures_are_written_whole_and_leave_no_state(tmp_path):
    before = dict(matplotlib.rcParams)
    assert draw_pictures(write_run(tmp_path), names=("losses.png", "modes.png")) == {}
    files = sorted((tmp_path / "plots").iterdir())
    assert [file.name for file in files] == ["losses.png", "modes.png"]  # nothing half-written
    for file in files:
        image = np.asarray(Image.open(file).convert("L"))
        assert min(image.shape) > 300 and image.std() > 5
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_every_picture_has_words_and_a_command():
    for item in PICTURES.values():
        assert item.title and len(item.caption_for(RunFacts(Path("run")))) > 40
        assert item.made_by.startswith("koap ") and "{run}" in item.made_by


def test_drawing_needs_neither_training_nor_simulator(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)  # with it, MuJoCo is imported first
    heavy = ("torchrl", "mujoco", "numba", "matplotlib.pyplot", "torchrl_koap.training", "torchrl_koap.envs")
    code = (
        "import sys; from torchrl_koap.reports.pictures import all_pictures; all_pictures();"
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[]"
