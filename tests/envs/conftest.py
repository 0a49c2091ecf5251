# This source code is licensed under the MIT license found in the LICENSE file.
"""Skips tests that draw on machines without OpenGL."""

import mujoco
import pytest

from torchrl_koap.envs.mujoco.rendering import Renderer


@pytest.fixture(scope="session")
def graphics():
    try:
        Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except RuntimeError as error:
        pytest.skip(f"no picture can be drawn on this machine: {error}")
