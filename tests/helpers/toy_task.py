# This source code is licensed under the MIT license found in the LICENSE file.
"""Arguments of a small task with a commanded tool and a box."""

from torchrl_koap.tasks import Action

TOY = {
    "name": "toy",
    "observation_parts": {"command": 2, "tool": 2, "box_xy": 2, "box_tan_yaw": 1},
    "actions": {"x": Action("m"), "y": Action("m")},
    "position": "tool",
    "command": "command",
}
