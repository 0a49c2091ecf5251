# This source code is licensed under the MIT license found in the LICENSE file.
"""The module here is imported by the tests that need it, not collected: importing registers a method."""

collect_ignore = ["nearest_neighbour.py"]
