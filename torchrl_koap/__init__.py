# This source code is licensed under the MIT license found in the LICENSE file.
"""TorchRL components for imitation learning with few action labels."""

__version__ = "0.1.0"
