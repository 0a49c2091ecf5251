# This source code is licensed under the MIT license found in the LICENSE file.
"""The modules here are imported by the tests that need them, not collected: importing registers task or method."""

collect_ignore = ["arm_data.py", "nearest_neighbour.py"]
