# This source code is licensed under the MIT license found in the LICENSE file.
"""What a run is on disk and around a process: its options, files, weights, progress, plugins and device."""
