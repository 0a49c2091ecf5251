# This source code is licensed under the MIT license found in the LICENSE file.
"""From demonstrations to a run directory with planner and controller."""
