# This source code is licensed under the MIT license found in the LICENSE file.
"""The packages here are imported by the tests that need them, not collected: importing registers their tasks."""

collect_ignore = ["puck", "arm_data.py", "nearest_neighbour.py"]
