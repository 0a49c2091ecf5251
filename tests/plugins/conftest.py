# This source code is licensed under the MIT license found in the LICENSE file.
"""Keeps pytest from collecting the plugin module, since importing it registers a method."""

collect_ignore = ["nearest_neighbour.py"]
