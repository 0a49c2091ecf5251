# This source code is licensed under the MIT license found in the LICENSE file.
"""Many runs: label-efficiency curves and the paper's tables."""
