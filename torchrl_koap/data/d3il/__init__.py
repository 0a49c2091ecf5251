# This source code is licensed under the MIT license found in the LICENSE file.
"""Reading D3IL's raw demonstrations: restricted unpickling, conversion, replay buffer."""
