# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures, their cameras, and what is said where none can be drawn."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.envs.mujoco import rendering


@pytest.fixture(scope="module")
def env():
    env = AvoidingEnv(2)
    actions = torch.tensor([[0.006, 0.01], [0.0, 0.0]])
    env.rollout(15, lambda td: td.set("action", actions))
    try:
        env.render(0, 32, 32)
    except RuntimeError as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")
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
    assert np.nonzero(red)[0].mean() > 120  # the cylinders stand in the lower part


def test_environments_look_different(env):
    assert np.abs(env.render(0, 64, 64).astype(int) - env.render(1, 64, 64)).max() > 50


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"camera": "wist"}, "did you mean 'wrist'"),
        ({"index": 2}, "0 to 1, got 2"),
        ({"width": 0}, "width must be a positive number of pixels, got 0"),
    ],
)
def test_what_cannot_be_drawn_is_named(env, asked, message):
    with pytest.raises(ValueError, match=message):
        env.render(**asked)


def test_backends(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert rendering.backends() == ["osmesa"]
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(RuntimeError, match="switched off.*MUJOCO_GL=disable"):
        rendering.backends()
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(RuntimeError, match="'vulkan' is no OpenGL back end"):
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


def test_no_graphics_library_is_touched_without_a_picture():
    code = (
        "import os, sys\n"
        "import mujoco\n"  # it reads the variable itself and refuses unknown names, so it is set afterwards
        "os.environ['MUJOCO_GL'] = 'disable-this'\n"
        "from torchrl_koap.envs import AvoidingEnv\n"
        "AvoidingEnv(1).rollout(2)\n"
        "assert os.environ['MUJOCO_GL'] == 'disable-this', os.environ['MUJOCO_GL']\n"
        "assert not [name for name in sys.modules if name.startswith('OpenGL')]\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
