# This source code is licensed under the MIT license found in the LICENSE file.
"""Policies that act in an environment: plan then control, action chunks, replay."""
