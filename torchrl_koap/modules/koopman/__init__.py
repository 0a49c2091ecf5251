# This source code is licensed under the MIT license found in the LICENSE file.
"""Koopman inverse dynamics: lifting, linear operator, latent action and linear decoder."""
