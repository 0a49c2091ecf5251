# This source code is licensed under the MIT license found in the LICENSE file.
"""Diffusion models of sequences: noise schedule, solvers, denoisers, planner and Diffusion Policy."""
