# This source code is licensed under the MIT license found in the LICENSE file.
"""Policies of torchrl_koap for LeRobot, which imports this package by its name and finds ``koap`` registered."""

from lerobot_policy_koap.configuration_koap import KoapConfig
from lerobot_policy_koap.modeling_koap import KoapPolicy
from lerobot_policy_koap.processor_koap import make_koap_pre_post_processors

__all__ = ["KoapConfig", "KoapPolicy", "make_koap_pre_post_processors"]
