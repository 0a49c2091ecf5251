# This source code is licensed under the MIT license found in the LICENSE file.
"""Puck: a point robot pushes a puck around the left or the right side of a post to a goal."""

from __future__ import annotations

from torchrl_koap import Task, register_task
from torchrl_koap.tasks import Action, Body, Defaults, Modes, Scene, Shape

GOAL, GOAL_RADIUS = (0.5, 0.4), 0.05  # m
POST, GATE_Y = (0.5, 0.2), 0.2  # where the side is decided (m)
PUCK_RADIUS, ROBOT_RADIUS = 0.03, 0.01  # m
START = ((0.4, 0.6), (0.05, 0.1))  # of the puck: x range, y range (m)


def goal_reached(task, state):
    """Whether the puck is in the goal, bool ``[*B]`` of states ``[*B, 4]``."""
    return (state[..., task.state_slices["puck_xy"]] - state.new_tensor(GOAL)).norm(dim=-1) < GOAL_RADIUS


def mode_index(mode):
    """Side on which the puck passed the post, ``[*B]`` of the leaf ``mode`` ``[*B, 1]``."""
    return mode[..., 0].long()


def score(result, episodes, contexts):
    """The share of the episodes that took the left side."""
    sides = [int(episode[-1]["next", "mode"]) for episode in episodes]
    return {"rates": {"passed on the left": [side == 0 for side in sides]}}


TASK = register_task(
    Task(
        name="puck",
        observation_parts={"robot_xy": ("x", "y"), "puck_xy": ("puck_x", "puck_y")},
        actions={"x": Action("m", column=0), "y": Action("m", column=1)},
        position="robot_xy",
        max_steps=200,
        control_hz=20.0,
        robot=(0, 1),
        relative_positions=(("robot_xy", "puck_xy"),),
        goal="puck.task:goal_reached",
        modes=Modes((("side", ("left", "right")),), index="puck.task:mode_index", entropy="solved_contexts"),
        score="puck.task:score",
        env="puck.env:PuckEnv",
        expert="puck.expert:PuckExpert",
        scene=Scene(
            shapes=(
                Shape("circle", GOAL, (GOAL_RADIUS, GOAL_RADIUS), "zone", label="goal"),
                Shape("circle", POST, (0.01, 0.01), "obstacle"),
            ),
            bodies=(Body("puck", "puck_xy", starts=(START,), color="blue", half=(PUCK_RADIUS, PUCK_RADIUS)),),
            x=(0.2, 0.8),
            y=(-0.05, 0.55),
            caption=" The puck passes the post on one side.",
        ),
        defaults=Defaults(demonstrations=12, planner={"steps": 100, "width": 16}),
    )
)
