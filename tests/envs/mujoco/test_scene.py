# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the arm's numbers, its variants and the errors of a missing mesh package."""

import importlib
import importlib.util
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import pytest
from packaging.requirements import Requirement

from torchrl_koap.envs.mujoco import scene
from torchrl_koap.envs.mujoco.kinematics import Q_REST
from torchrl_koap.envs.mujoco.scene import compile_scene, panda


def compiled(**arguments) -> mujoco.MjModel:
    return compile_scene(panda(**arguments))


@pytest.mark.parametrize("link_collisions", [False, True])
def test_what_collides(link_collisions):
    model = compiled(rod=True, link_collisions=link_collisions)
    for name in ("rod", "finger_left", "finger_right", "pad_left", "pad_right", "hand"):
        assert model.geom(name).contype == 1
    for name in ("link0", "link5", "link7"):
        assert model.geom(name).contype == int(link_collisions)
    assert model.nexclude == 9


def test_consecutive_links_never_collide_although_their_hulls_overlap():
    model = compiled(rod=True, link_collisions=True)
    data = mujoco.MjData(model)
    data.qpos[:7] = Q_REST
    data.qpos[7:] = 0.02
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def test_the_rod_ends_12_cm_below_the_tcp():
    model = compiled(rod=True)
    rod = model.geom("rod")
    assert rod.pos[2] + rod.size[1] - model.body("tcp").pos[2] == pytest.approx(0.12)
    assert model.geom("rod_tip").contype == 0
    plain = compiled(rod=False)
    assert mujoco.mj_name2id(plain, mujoco.mjtObj.mjOBJ_GEOM, "rod") == -1 and plain.nq == 9


def test_a_missing_mesh_package_is_named(monkeypatch, tmp_path):
    specs = {"gymnasium_robotics": None}
    monkeypatch.setattr(importlib.util, "find_spec", specs.get)
    with pytest.raises(ImportError, match="gymnasium-robotics"):
        panda()
    specs["gymnasium_robotics"] = SimpleNamespace(origin=str(tmp_path / "__init__.py"))
    with pytest.raises(FileNotFoundError, match="link0.stl"):
        panda()


def test_without_dm_control_the_step_that_installs_it_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", {}.get)
    monkeypatch.delitem(sys.modules, scene.__name__)
    with pytest.raises(RuntimeError, match="pip install --no-deps dm-control"):
        importlib.import_module(scene.__name__)


def test_every_requirement_has_wheels_on_later_pythons():
    """Labmaze, which dm-control asks for, has none: there dm-control itself must not be a requirement."""
    text = (
        (Path(__file__).parents[3] / "pyproject.toml").read_text().partition("dependencies = [")[2].partition("\n]")[0]
    )
    asked = [Requirement(each) for each in re.findall(r'^    "(.+)",$', text, re.MULTILINE)]
    later = {each.name for each in asked if each.marker is None or each.marker.evaluate({"python_version": "3.13"})}
    assert "torchrl" in later
    assert not later & {"dm-control", "labmaze"}
