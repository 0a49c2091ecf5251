# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests pictures, their cameras, and the errors of machines that cannot draw."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.envs.mujoco import rendering


@pytest.fixture(scope="module")
def env(graphics):
    env = AvoidingEnv(2)
    actions = torch.tensor([[0.006, 0.01], [0.0, 0.0]])
    env.rollout(15, lambda td: td.set("action", actions))
    yield env
    env.close()


@pytest.mark.parametrize("camera", ["front", "cage", "wrist"])
def test_picture_shows_the_scene(env, camera):
    picture = env.render(0, 160, 120, camera)
    assert picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    assert picture.std() > 5
    np.testing.assert_array_equal(picture, env.render(0, 160, 120, camera))


def test_picture_has_red_cylinders_green_line_and_the_right_way_up(env):
    picture = env.render(0, 320, 320, "front").astype(int)
    red = (picture[..., 0] > 120) & (picture[..., 1] < 40) & (picture[..., 2] < 40)
    green = (picture[..., 1] > 180) & (picture[..., 0] < 60)
    assert red.sum() > 500 and green.sum() > 200
    assert np.nonzero(green)[1].mean() > np.nonzero(red)[1].mean()  # y grows to the right
    assert np.nonzero(red)[0].mean() > 165  # the cylinders stand in the lower half


def test_environments_look_different(env):
    assert np.abs(env.render(0, 64, 64).astype(int) - env.render(1, 64, 64)).max() > 50


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"camera": "wist"}, "did you mean 'wrist'"),
        ({"width": 0}, "width must be a positive number of pixels, got 0"),
    ],
)
def test_what_cannot_be_drawn_is_named(env, asked, message):
    before = env.render()
    with pytest.raises(ValueError, match=message):
        env.render(**asked)
    np.testing.assert_array_equal(env.render(), before)


def test_backends(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert rendering.backends() == ["osmesa"]
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(RuntimeError, match="switched off.*MUJOCO_GL=disable"):
        rendering.backends()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="choice of back ends on Linux")
def test_back_end_follows_the_display(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    assert rendering.backends() == ["egl", "osmesa"]
    monkeypatch.setenv("DISPLAY", ":0")
    assert rendering.backends()[0] == "glfw"


def test_missing_library_says_what_to_install(monkeypatch):
    monkeypatch.setattr(rendering, "backends", lambda: ["egl", "osmesa"])

    def refuse(name):
        raise ImportError(f"no {name}")

    monkeypatch.setattr(rendering.importlib, "import_module", refuse)
    with pytest.raises(RuntimeError, match="egl: ImportError.*libegl1.*MUJOCO_GL=egl.*libosmesa6"):
        AvoidingEnv(1).render()


@pytest.mark.parametrize("chosen", ["n0nsense", "osmesa"])  # one that there is not, and one that may not be installed
def test_what_draws_nothing_needs_no_back_end(chosen):
    code = (
        "import os, sys\n"
        "from torchrl_koap.envs import AvoidingEnv\n"
        "AvoidingEnv(1).rollout(2)\n"
        f"assert os.environ['MUJOCO_GL'] == '{chosen}', os.environ['MUJOCO_GL']\n"
        "assert os.environ.get('PYOPENGL_PLATFORM') != 'osmesa' or 'mujoco.osmesa' in sys.modules\n"
    )
    settings = {**os.environ, "MUJOCO_GL": chosen}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=settings)
    assert done.returncode == 0, done.stderr


def test_a_context_without_a_window_is_no_back_end(monkeypatch):
    class Blank:
        def __init__(self, width, height): ...

        def make_current(self): ...

    monkeypatch.setitem(sys.modules, "mujoco.glfw", SimpleNamespace(GLContext=Blank))
    with ThreadPoolExecutor(1) as thread:  # a window that another test left open is of the main thread
        opening = thread.submit(rendering.open_context, ["glfw"], mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
    with pytest.raises(RuntimeError, match="could be used to draw .glfw: FatalError: "):
        opening.result()


@pytest.mark.parametrize(
    ("probe", "said"),
    [
        ("import os; assert os.environ['MUJOCO_GL'] == '{}'", ""),
        ("raise ImportError('no {} here')", "ImportError: no egl here"),
        ("import os; os.kill(os.getpid(), 9)", "it ended with status -9"),
    ],
)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="back ends of Linux")
def test_a_back_end_is_tried_in_a_process_of_its_own(monkeypatch, probe, said):
    monkeypatch.setattr(rendering, "_PROBE", probe)
    found = rendering.try_backends()
    assert list(found) == ["egl", "osmesa", "glfw"] and found["egl"] == said
