# This source code is licensed under the MIT license found in the LICENSE file.
"""Scripted operators of the tasks and the recording of their demonstrations."""
