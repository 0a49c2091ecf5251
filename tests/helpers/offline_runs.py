# This source code is licensed under the MIT license found in the LICENSE file.
"""Records and trains a toy robot without environment: joints follow delta commands with a lag, few are labelled."""

from pathlib import Path

import numpy as np

from torchrl_koap import ControllerConfig, PlannerConfig, TrainConfig, Trained, fit, train
from torchrl_koap.data import make_demonstrations, save_ted

NAMES = ["q1", "q2", "goal_1", "goal_2"]
TINY = {"planner": {"steps": 20, "batch_size": 8, "width": 8}, "controller": {"steps": 20}}


def record(count: int = 10, steps: int = 40, joints: int = 7, *, seed: int = 0):
    """Returns states ``[steps, 2 * joints]`` (joints and their goals) and actions ``[steps, joints]``."""
    generator = np.random.default_rng(seed)
    states, actions = [], []
    for _ in range(count):
        joint, goal, speed = *generator.uniform(-1, 1, (2, joints)), np.zeros(joints)
        frames, commands = [], []
        for _ in range(steps):
            command = 0.15 * (goal - joint) + generator.normal(0, 0.002, joints)
            frames.append(np.r_[joint, goal])
            commands.append(command)
            speed = 0.6 * speed + 0.4 * command
            joint = joint + speed
        states.append(np.array(frames))
        actions.append(np.array(commands))
    return states, actions


def few_labels(labelled=2, **options):
    """Returns arguments of ``make_demonstrations``: a robot of two joints, of which some recordings are labelled."""
    states, actions = record(6, joints=2)
    actions = [steps if index < labelled else None for index, steps in enumerate(actions)]
    return {"states": states, "actions": actions, "control_hz": 30, "state_names": NAMES, "robot": NAMES[:2]} | options


def fit_walks(columns: int, **description) -> Trained:
    """Trains two updates on random walks of a robot with two columns; one walk has its steps as actions."""
    random = np.random.default_rng(0)
    states = [random.normal(size=(40, columns)).cumsum(0) for _ in range(3)]
    actions = [np.diff(states[0][:, :2], axis=0), None, None]
    data, task = make_demonstrations(states, actions, control_hz=30, robot=[0, 1], **description)
    return fit(data, task, method="linear", planner={"steps": 2, "width": 8}, progress=False)


def save_arm(
    folder: Path,
    *,
    count: int = 10,
    labelled: int = 3,
    joints: int = 7,
    units: str | list[str] = "rad",
) -> Path:
    states, actions = record(count, joints=joints)
    data, task = make_demonstrations(
        states,
        [action if number < labelled else None for number, action in enumerate(actions)],
        name="arm",
        control_hz=30,
        state_names=[f"q{joint}" for joint in range(joints)] + [f"goal{joint}" for joint in range(joints)],
        state_units=units if isinstance(units, str) else [*units, *units],
        action_names=[f"dq{joint}" for joint in range(joints)],
        action_units=units,
        robot=list(range(joints)),
    )
    return save_ted(data, folder / "ted", task=task).parent


def train_arm(out: Path, dataset: Path, **options) -> Path:
    """Trains a tiny run; sections given as mappings override single options."""
    sections = {}
    for name, kind in {"planner": PlannerConfig, "controller": ControllerConfig}.items():
        asked = options.pop(name, {})
        sections[name] = asked if isinstance(asked, kind) else kind(**TINY[name] | asked)
    train(TrainConfig(dataset=str(dataset), out=out, **sections, **options))
    return out
