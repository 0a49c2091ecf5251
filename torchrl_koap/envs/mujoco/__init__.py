# This source code is licensed under the MIT license found in the LICENSE file.
"""The Panda in MuJoCo: models, compiled controller, inverse kinematics, rendering."""
