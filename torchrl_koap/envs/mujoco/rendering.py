# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws pictures of a simulation. Graphics libraries are loaded for the first picture, never before."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np

from torchrl_koap.lookup import lookup

_SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")
INSTALL = (
    "on a machine without display install EGL (apt-get install libegl1) and set MUJOCO_GL=egl, or software rendering"
    " (apt-get install libosmesa6) and set MUJOCO_GL=osmesa"
)
# opens a window and graphics memory; imports only the simulator
_PROBE = """
import importlib, mujoco, warnings
warnings.simplefilter("ignore")
context = importlib.import_module("mujoco.{}").GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100.value)
"""


def backends() -> list[str]:
    """Lists the OpenGL back ends to try, in order: the one named by ``MUJOCO_GL``, otherwise those of this platform."""
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen in _SWITCHED_OFF:
        raise RuntimeError(f"rendering is switched off by the environment variable MUJOCO_GL={chosen}")
    if chosen in ("egl", "osmesa", "glfw", "cgl"):
        return [chosen]
    if sys.platform == "darwin":
        return ["cgl", "glfw"]
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return ["egl", "osmesa"]
    return ["glfw", "egl", "osmesa"] if sys.platform.startswith("linux") else ["glfw"]


def open_context(names: Sequence[str], model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """Opens window and graphics memory of the first usable back end; without one, a RuntimeError gives the reasons."""
    reasons = []
    for name in names:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
                context.make_current()
                return context, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # the back ends raise whatever their libraries raise
            said = " ".join(str(error).split())
            reasons.append(f"{name}: {type(error).__name__}: {said}")
    raise RuntimeError(f"no OpenGL library could be used to draw ({'; '.join(reasons)}); {INSTALL}")


def try_backends() -> dict[str, str]:
    """Tries every back end of this system in a process of its own; returns errors by name, "" for none."""
    known = {"darwin": ("cgl", "glfw"), "linux": ("egl", "osmesa", "glfw")}.get(sys.platform, ("glfw",))
    return {name: _try(name) for name in known}


def _try(name: str) -> str:
    words = [sys.executable, "-c", _PROBE.format(name)]
    try:
        done = subprocess.run(words, env={**os.environ, "MUJOCO_GL": name}, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return "no answer in 60 s"
    if done.returncode == 0:
        return ""
    said = done.stderr.strip().splitlines()
    return said[-1] if said else f"it ended with status {done.returncode}"


class Renderer:
    """Draws simulations of one model into arrays [height, width, 3].

    Software rendering takes half the time without ``shadows``. Raises a RuntimeError if no OpenGL library can be used.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, *, shadows: bool = True):
        for name, size in (("width", width), ("height", height)):
            if not isinstance(size, int) or size < 1:
                raise ValueError(f"{name} must be a positive number of pixels, got {size!r}")
        self.size = (width, height)
        self._model, self._shadows = model, shadows
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._context, self._gpu = open_context(backends(), model, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = shadows
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gpu)

    def __reduce__(self) -> tuple[Any, ...]:  # a copy opens its own context
        return partial(Renderer, shadows=self._shadows), (self._model, *self.size)

    def render(self, data: mujoco.MjData, camera: str) -> np.ndarray:
        """Draws one simulation, uint8 [height, width, 3]; the camera's name needs no arm prefix."""
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        names = {self._model.camera(index).name.removeprefix("panda/"): index for index in range(self._model.ncam)}
        self._camera.fixedcamid = lookup(names, camera.removeprefix("panda/"), "camera")
        self._context.make_current()
        perturbation, everything = mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, perturbation, self._camera, everything, self._scene)
        width, height = self.size
        viewport = mujoco.MjrRect(0, 0, width, height)
        picture = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_render(viewport, self._scene, self._gpu)
        mujoco.mjr_readPixels(picture, None, viewport, self._gpu)
        return np.ascontiguousarray(picture[::-1])  # OpenGL counts rows from below

    def close(self) -> None:
        """Frees the graphics memory; the renderer cannot be used afterwards."""
        if self._context is not None:
            self._context.make_current()
            self._gpu.free()
            self._context.free()
            self._context = None
