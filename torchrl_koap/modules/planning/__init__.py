# This source code is licensed under the MIT license found in the LICENSE file.
"""Diffusion models over sequences: schedules, solvers, denoisers, planner, policy."""
