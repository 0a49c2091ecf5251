# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the compiled controller against MuJoCo's kinematics, NumPy's linear algebra and recorded substeps."""

import mujoco
import numpy as np
import pytest

from torchrl_koap.envs.avoiding import AvoidingEnv
from torchrl_koap.envs.mujoco import kinematics
from torchrl_koap.envs.mujoco.scene import compile_scene, panda, scene


@pytest.fixture(scope="module")
def model():
    root = scene()
    root.attach(panda())
    return compile_scene(root)


@pytest.fixture
def generator():
    return np.random.default_rng(0)


def pose_of(q):
    axes, origins, tcp, quat = np.empty((8, 3, 3)), np.empty((8, 3)), np.empty(3), np.empty(4)
    kinematics.forward_kinematics(q, axes, origins, tcp, quat)
    return axes, origins, tcp, quat


def numpy_inverse_kinematics(target, q):
    """Inverse kinematics of the controller in plain NumPy, with an explicit singular value decomposition."""
    q = q.copy()
    for _ in range(3):
        axes, origins, tcp, r = pose_of(q)
        t = target[3:] if target[3:] @ r >= 0 else -target[3:]
        e_p = np.clip(target[:3] - tcp, -0.01, 0.01)
        e_o = np.clip(r[0] * t[1:] - t[0] * r[1:] + np.cross(r[1:], t[1:]), -0.1, 0.1)
        u = np.concatenate([[200, 200, 800] * e_p, 30 * e_o])
        z = axes[1:, 2]
        jacobian = np.concatenate([np.cross(z, tcp - origins[1:]), z], axis=1).T
        left, values, right = np.linalg.svd(jacobian @ jacobian.T + 1e-12 * np.eye(6))
        inverse = right.T @ np.diag(1 / np.clip(values, 0.01, 100)) @ left.T
        null = 40 * np.clip(kinematics.Q_REST - q, -0.2, 0.2)
        v = jacobian.T @ inverse @ (u - jacobian @ null) + null
        v *= min(1.0, 3 / np.linalg.norm(v))
        q = np.clip(q + 0.001 * v, kinematics.Q_MIN, kinematics.Q_MAX)
    return q


def compiled_inverse_kinematics(target, q):
    q = q.copy()
    kinematics.inverse_kinematics(target, q)
    return q


def test_forward_kinematics_agree_with_mujoco(model, generator):
    data, tcp_body = mujoco.MjData(model), model.body("panda/tcp").id
    for _ in range(50):
        q = generator.uniform(kinematics.Q_MIN, kinematics.Q_MAX)
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        _, origins, tcp, quat = pose_of(q)
        np.testing.assert_allclose(tcp, data.xpos[tcp_body], atol=1e-12)
        np.testing.assert_allclose(origins[1:], data.xanchor[:7], atol=1e-12)
        # the physics model's hand is turned by a rounded -45 deg, 1.2e-6 rad off
        assert abs(abs(quat @ data.xquat[tcp_body]) - 1) < 1e-11


def test_inverse_kinematics_equal_the_numpy_version(generator):
    start = np.array(AvoidingEnv.START_JOINTS)
    pose = np.concatenate([pose_of(start)[2], [0, 1, 0, 0]])
    for index in range(60):
        # far commands, both signs of the quaternion, and postures near singularities and joint limits
        q = start if index < 20 else generator.uniform(kinematics.Q_MIN, kinematics.Q_MAX)
        target = pose.copy()
        target[:3] += generator.normal(0, 0.05, 3)
        target[3:] *= 1 if index % 2 else -1
        np.testing.assert_allclose(
            compiled_inverse_kinematics(target, q), numpy_inverse_kinematics(target, q), rtol=0, atol=1e-10
        )
