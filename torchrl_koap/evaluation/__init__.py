# This source code is licensed under the MIT license found in the LICENSE file.
"""What a trained run is worth: rollouts, statistics, diagnosis."""
