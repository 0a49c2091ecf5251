# This source code is licensed under the MIT license found in the LICENSE file.
"""Sorting: push red and blue cubes over the far edge of a platform into bins of their colour.

With two, four or six boxes; PO-Sorting has four, whose yaws are hidden, and noise on the tool's position.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import torch
from torch import Tensor

from torchrl_koap.tasks.action_rules import Action
from torchrl_koap.tasks.modes import Modes
from torchrl_koap.tasks.registry import register_task
from torchrl_koap.tasks.scene import Body, Scene, Shape
from torchrl_koap.tasks.task import Defaults, Task

# of PO-Sorting: episodes are short, and noise makes predicted actions too small; chosen with one trained planner
ACTION_GAIN = 1.15
COLOURS = ("red", "blue")
BIN_X = (0.4, 0.625)  # centre of the red and of the blue bin (m)
BIN_Y = 0.32
BIN_HALF = 0.1  # a bin reaches this far to both sides
BIN_RANGE = (0.22, 0.41)  # y between which a box counts as inside (m)
# walls of a bin, relative to its centre: x, y, half width, half depth (m)
BIN_WALLS = (
    (0.0, BIN_RANGE[1] - BIN_Y, BIN_HALF, 0.01),
    (-BIN_HALF, 0.0, 0.005, BIN_HALF),
    (BIN_HALF, 0.0, 0.005, BIN_HALF),
    (0.0, BIN_RANGE[0] - BIN_Y, BIN_HALF, 0.005),
)
BOX_HALF = 0.03  # half width of a box (m)
PLATFORM_X, PLATFORM_Y = (0.2, 0.8), (-0.4, 0.2)  # m
COMMAND_LEAD = 0.1  # m; scripted demonstrations keep the command within 0.097 of the robot
TEMPERATURE = 0.5  # of plans; no mode is lost, and fewer boxes get stuck
PO_NOISE = 0.002  # m; of PO-Sorting, in demonstrations as well as in evaluation; the paper states no figure
# six regions (x range, y range in m) that are assigned to the boxes at random
REGIONS = tuple((x, y) for x in ((0.4, 0.5), (0.55, 0.65)) for y in ((-0.15, -0.1), (-0.05, 0.0), (0.05, 0.1)))
_CAPTION = (
    " The second panel shows the boxes: pale outlines where they start, paths in their colours, a dot where they end, a"
    " cross in rollouts that failed. The grey square is the platform, the coloured frames are the bins. Look for boxes"
    " that end in a bin of the other colour, beside the bins, or nowhere near them."
)


def box_colours(num_boxes: int) -> list[int]:
    """Returns the colours of the boxes in the order of the state, red ones (0), then blue ones (1)."""
    return [0] * (num_boxes // 2) + [1] * (num_boxes // 2)


def in_bins(boxes: Tensor) -> Tensor:
    """Returns which boxes at ``[*B, boxes, 2]`` (x, y in m) are in the bins of their colours, bool ``[*B, boxes]``."""
    x, y = boxes.unbind(-1)
    centre = x.new_tensor(BIN_X)[box_colours(boxes.shape[-2])]
    return ((x - centre).abs() < BIN_HALF) & (y > BIN_RANGE[0]) & (y < BIN_RANGE[1])


def goal_reached(task: Task, state: Tensor) -> Tensor:
    """Returns whether every box is in the bin of its colour, bool ``[*B]``, for states ``[*B, d]``."""
    return in_bins(torch.stack([state[..., task.state_slices[f"{box}_xy"]] for box in task.objects], -2)).all(-1)


@functools.cache
def arrival_orders(num_boxes: int) -> tuple[tuple[int, ...], ...]:
    """Returns the modes: all orders in which the colours (0 red, 1 blue) can arrive, sorted lexicographically."""
    return tuple(sorted(set(itertools.permutations(box_colours(num_boxes)))))


_WALLS = tuple(
    Shape("rectangle", (x + across, BIN_Y + along), (width, depth), "wall", color)
    for color, x in zip(COLOURS, BIN_X, strict=True)
    for across, along, width, depth in BIN_WALLS
)


def _sorting(num_boxes: int) -> Task:
    boxes = {f"{colour}_{index + 1}": colour for colour in COLOURS for index in range(num_boxes // 2)}
    columns = {part: size for box in boxes for part, size in ((f"{box}_xy", 2), (f"{box}_tan_yaw", 1))}
    orders = tuple(", ".join(COLOURS[colour] for colour in order) for order in arrival_orders(num_boxes))
    return Task(
        name="sorting" if num_boxes == 4 else f"sorting_{num_boxes}",
        observation_parts={"desired_xy": 2, "measured_xy": 2} | columns,
        command="desired_xy",
        position="measured_xy",
        actions={"x": Action("m", column=0), "y": Action("m", column=1)},
        max_steps=700,
        robot=(0, 1),
        state={"measured_xy": "plain"} | {name: "tan_yaw" if size == 1 else "plain" for name, size in columns.items()},
        relative_positions=tuple(("measured_xy", f"{box}_xy") for box in boxes),
        interchangeable=tuple(tuple(box for box in boxes if boxes[box] == colour) for colour in COLOURS),
        goal="torchrl_koap.tasks.sorting:goal_reached",
        modes=Modes((("order of arrival", orders),), leaves=arrival_orders(num_boxes), entropy="solved_contexts"),
        env="torchrl_koap.envs.sorting:SortingEnv",
        env_options={"num_boxes": num_boxes},
        expert="torchrl_koap.envs.experts.sorting:SortingExpert",
        scene=Scene(
            shapes=(Shape.over((PLATFORM_X, PLATFORM_Y), "platform"), *_WALLS),
            bodies=tuple(
                Body(
                    box, f"{box}_xy", f"{box}_tan_yaw", label=f"{colour} boxes", color=colour, half=(BOX_HALF, BOX_HALF)
                )
                for box, colour in boxes.items()
            ),
            shared_starts=REGIONS,
            x=(0.17, 0.83),
            y=(-0.43, 0.45),
            caption=_CAPTION,
            camera="cage",
        ),
        defaults=Defaults(
            demonstrations=1000,
            planner={"steps": 16000, "network": "objects", "frames": 1},
            execution={"lead": COMMAND_LEAD, "temperature": TEMPERATURE},
            recovery=0.004,
        ),
    )


_BY_BOXES = {num_boxes: register_task(_sorting(num_boxes)) for num_boxes in (4, 2, 6)}
register_task(
    replace(
        _BY_BOXES[4],
        name="po_sorting",
        max_steps=400,
        hidden=tuple(f"{box}_tan_yaw" for box in _BY_BOXES[4].objects),
        noise=PO_NOISE,
        data_from="sorting",
        defaults=replace(
            _BY_BOXES[4].defaults,
            controller={"preset": "semi_supervised"},  # positions are noisy
            execution={"lead": COMMAND_LEAD, "temperature": TEMPERATURE, "gain": ACTION_GAIN},
        ),
    )
)


def sorting_task(num_boxes: int) -> Task:
    """Returns the task with 2, 4 or 6 boxes."""
    if num_boxes not in _BY_BOXES:
        raise ValueError(f"num_boxes must be one of {', '.join(map(str, sorted(_BY_BOXES)))}, got {num_boxes!r}")
    return _BY_BOXES[num_boxes]
