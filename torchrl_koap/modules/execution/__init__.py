# This source code is licensed under the MIT license found in the LICENSE file.
"""Policies that act in an environment: they follow plans or execute action chunks."""
