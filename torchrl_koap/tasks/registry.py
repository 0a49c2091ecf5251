# This source code is licensed under the MIT license found in the LICENSE file.
"""The D3IL tasks: everything that differs from task to task on the learning side, in one table."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from torchrl_koap.lookup import lookup
from torchrl_koap.tasks.task import CONTROL_HZ, Task


def _parts(*named: tuple[str, int]) -> dict[str, slice]:
    parts, start = {}, 0
    for name, size in named:
        parts[name] = slice(start, start + size)
        start += size
    return parts


def _sorting(num_boxes: int, num_modes: int) -> Task:
    boxes = [f"{colour}_{index + 1}" for colour in ("red", "blue") for index in range(num_boxes // 2)]
    columns = [part for box in boxes for part in ((f"{box}_xy", 2), (f"{box}_tan_yaw", 1))]
    return Task(
        name="sorting" if num_boxes == 4 else f"sorting_{num_boxes}",
        observation=_parts(("desired_xy", 2), ("measured_xy", 2), *columns),
        command="desired_xy",
        position="measured_xy",
        action_dim=2,
        max_steps=700,
        control_hz=CONTROL_HZ,
        num_modes=num_modes,
        actuated=(0, 1),
        robot=(0, 1),
        state={"measured_xy": "plain"} | {name: "tan_yaw" if size == 1 else "plain" for name, size in columns},
        objects=tuple(boxes),
        drawn={box: f"{box}_xy" for box in boxes},
        entropy="solved_contexts",
        relations=tuple(("measured_xy", f"{box}_xy") for box in boxes),
        alike=(tuple(boxes[: num_boxes // 2]), tuple(boxes[num_boxes // 2 :])),
    )


_STACKING_BOXES = ("red", "green", "blue")
_stacking = Task(
    name="stacking",
    observation=_parts(
        ("desired_joints_and_gripper", 8),
        *(part for box in _STACKING_BOXES for part in ((f"{box}_position", 3), (f"{box}_tan_yaw", 1))),
        ("measured_joints", 7),
        ("gripper_width", 1),
        ("tcp_position", 3),
    ),
    command="desired_joints_and_gripper",
    position="tcp_position",
    action_dim=8,
    max_steps=1000,
    control_hz=1 / 0.03,
    num_modes=6,
    robot=tuple(range(8)),
    gripper=(7, 7),
    state={"measured_joints": "plain", "gripper_width": "plain", "tcp_position": "plain"}
    | {
        name: kind
        for box in _STACKING_BOXES
        for name, kind in ((f"{box}_position", "plain"), (f"{box}_tan_yaw", "tan_yaw"))
    },
    objects=_STACKING_BOXES,
    drawn={box: f"{box}_position" for box in _STACKING_BOXES},
    action_unit="rad",
    entropy="solved_contexts",
    alike=(("red", "green"),),
    relations=(
        *(("tcp_position", f"{box}_position") for box in _STACKING_BOXES),
        *((f"{box}_position", f"{other}_position") for box, other in combinations(_STACKING_BOXES, 2)),
    ),
    recovery_sigma=0.0,  # measured: a shifted arm, redundant as it is, learns to wander (benchmarks/RESULTS.md)
)

_tasks = (
    Task(
        name="avoiding",
        observation=_parts(("desired_xy", 2), ("measured_xy", 2)),
        command="desired_xy",
        position="measured_xy",
        action_dim=2,
        max_steps=250,
        control_hz=CONTROL_HZ,
        num_modes=24,
        actuated=(0, 1),
        robot=(0, 1),
        collides=True,
        demonstrations=96,
        planner_steps=5000,
        channels=(32, 64),
        relative=False,
    ),
    Task(
        name="aligning",
        observation=_parts(
            ("desired_xyz", 3),
            ("measured_xyz", 3),
            ("box_position", 3),
            ("box_quaternion", 4),
            ("target_position", 3),
            ("target_quaternion", 4),
        ),
        command="desired_xyz",
        position="measured_xyz",
        action_dim=3,
        max_steps=400,
        control_hz=CONTROL_HZ,
        num_modes=2,
        actuated=(0, 1, 2),
        robot=(0, 1, 2),
        state={
            "measured_xyz": "plain",
            "box_position": "plane",
            "box_quaternion": "quaternion",
            "target_position": "plane",
            "target_quaternion": "quaternion",
        },
        objects=("box", "target"),
        drawn={"box": "box_position", "target": "target_position"},
        entropy="contexts",
        scene=("measured_xyz", "box_position", "box_quaternion", "target_position", "target_quaternion"),
        relations=(
            ("measured_xyz", "box_position", "box_quaternion"),
            ("target_position", "box_position", "box_quaternion", "target_quaternion"),
            ("measured_xyz", "target_position", "target_quaternion"),
        ),
    ),
    _sorting(4, num_modes=6),
    _sorting(2, num_modes=2),
    _sorting(6, num_modes=20),
    replace(
        _sorting(4, num_modes=6),
        name="po_sorting",
        max_steps=400,
        hidden=tuple(f"{box}_tan_yaw" for box in ("red_1", "red_2", "blue_1", "blue_2")),
        noise=0.002,
        data="sorting",
    ),
    _stacking,
    replace(_stacking, name="stacking_1", max_steps=400, num_modes=3, data="stacking"),
)
TASKS = {task.name: task for task in _tasks}


def get_task(name: str) -> Task:
    """Looks a task up by name.

    Raises:
        ValueError: if the name is unknown; the message suggests the nearest one.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> get_task("avoiding").state_columns, get_task("sorting").state_dim, get_task("po_sorting").state_dim
        ((2, 3), 18, 10)
    """
    return lookup(TASKS, name, "task")
