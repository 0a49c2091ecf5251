# This source code is licensed under the MIT license found in the LICENSE file.
"""The arm's numbers, its variants and the errors of a missing mesh package."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from torchrl_koap.envs.mujoco.kinematics import Q_REST
from torchrl_koap.envs.mujoco.scene import compile_scene, panda, scene


def compiled(**arguments) -> mujoco.MjModel:
    return compile_scene(panda(**arguments))


def test_masses_and_inertias_are_those_of_the_table():
    model = compiled(rod=True)
    links = 3.01399 + 2.77281 + 2.7996 + 2.14603 + 2.18807 + 3.19545 + 1.35761 + 0.417345
    rest = 0.1 + 0.670782 + 2 * (0.0218754 + 0.01) + 0.09424778 + 0.00418879
    assert model.body_mass.sum() == pytest.approx(links + rest, abs=1e-8)
    np.testing.assert_allclose(model.body("link8").inertia, 0.1)
    np.testing.assert_allclose(model.body("finger_tip_left").inertia, 0.01)
    np.testing.assert_allclose(model.body("tcp").mass, 0.0)


def test_joints_and_motors():
    model = compiled(rod=True)
    assert model.nq == model.nv == model.nu == 9
    np.testing.assert_allclose(model.joint("joint4").range, [-3.1416, 0.0873])
    np.testing.assert_allclose(model.dof_damping, [0.0] * 7 + [10.0] * 2)
    assert not model.dof_armature.any() and not model.dof_frictionloss.any()
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], [87.0] * 4 + [12.0] * 3 + [70.0] * 2)
    np.testing.assert_allclose(model.actuator_gear[:, 0], 1.0)
    assert not model.actuator_ctrllimited.any()


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


def test_scene_settings():
    model = compile_scene(scene())
    option = model.opt
    assert (option.timestep, option.impratio, option.tolerance, option.iterations) == (0.001, 3.0, 1e-10, 100)
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    table = model.geom("table_top")
    assert table.pos[2] + table.size[2] == pytest.approx(-0.019)


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
