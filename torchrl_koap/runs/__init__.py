# This source code is licensed under the MIT license found in the LICENSE file.
"""A run on disk and in a process: its options, files, weights, progress, plugins and device."""
