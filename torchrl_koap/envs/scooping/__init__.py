# This source code is licensed under the MIT license found in the LICENSE file.
"""Scooping: a Panda, or a hand, takes pieces out of a bowl in view of a camera."""

from torchrl_koap.envs.scooping.env import ScoopingEnv

__all__ = ["ScoopingEnv"]
