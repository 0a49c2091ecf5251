# This source code is licensed under the MIT license found in the LICENSE file.
"""Policies of torchrl_koap for LeRobot.

LeRobot imports this package by its name, which registers ``koap``, and the modules beside it when it needs them.
"""

from lerobot_policy_koap.configuration_koap import KoapConfig

__all__ = ["KoapConfig"]
