# This source code is licensed under the MIT license found in the LICENSE file.
"""
From your robot's arrays to a control loop
==========================================

**What you will learn**

* how arrays, most of them without actions, become a policy,
* how to save it, load it and call it once per tick, and how long that takes,
* what to measure before it moves the robot.

Run it with ``python tutorials/own_robot.py``; it writes ``own_robot.png``.
"""

# %%
# What was recorded
# -----------------
# Put your own recordings here: frames ``[T, d]`` of every trajectory, and commands ``[T - 1, a]`` of a few. The example
# is an arm of two joints that follows velocity commands with a lag. A person moved it to a goal, around an upright
# pole, on either side.

import tempfile
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict

import torchrl_koap

NAMES = ("joint_1", "joint_2", "goal_1", "goal_2")
POLE, CLEARANCE = np.array([0.0, 0.0]), 0.18  # in the space of the joints (rad)


class Arm:
    """What would be your driver: it takes a command and says where the joints are."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.joints = np.array([-0.8, 0.0]) + rng.normal(0, 0.05, 2)
        self.goal = np.array([0.8, rng.uniform(-0.3, 0.3)])
        self.speed = np.zeros(2)

    def read(self):
        return np.concatenate([self.joints, self.goal])

    def command(self, velocity):
        self.speed = 0.6 * self.speed + 0.4 * np.asarray(velocity)
        self.joints = self.joints + self.speed / 30


def person(arm, side, rng):
    """Frames and commands of one demonstration."""
    via, passed, frames, commands = np.array([0.0, side * rng.uniform(0.3, 0.45)]), False, [arm.read()], []
    for _ in range(75):
        passed = passed or arm.joints[0] > -0.05
        away = (arm.goal if passed else via) - arm.joints
        commands.append(1.2 * away / max(np.linalg.norm(away), 0.2) + rng.normal(0, 0.03, 2))
        arm.command(commands[-1])
        frames.append(arm.read())
    return np.array(frames), np.array(commands)


rng = np.random.default_rng(0)
recordings = [person(Arm(seed), 1 if seed % 2 else -1, rng) for seed in range(60)]
states = [frames for frames, _ in recordings]
actions = [commands if index < 3 else None for index, (_, commands) in enumerate(recordings)]

# %%
# Planner, controller, policy
# ---------------------------
# ``robot`` names the columns that the controller reads. Goals are not among them.

data, task = torchrl_koap.make_demonstrations(
    states, actions, control_hz=30, state_names=NAMES, state_units="rad", action_units="rad/s", robot=NAMES[:2]
)
print(f"{len(states)} trajectories, {int(data['has_action'].sum())} of {len(data)} steps with their command")
trained, planner = {}, {"steps": 500}
for name in ("linear", "dd", "koap"):
    trained[name] = torchrl_koap.fit(
        data, task, method=name, planner=planner, controller={"steps": 200}, progress=False
    )
    planner = trained[name].planner  # reads no command: all controllers share it

# %%
# Before it moves
# ---------------
# Commands predicted from *recorded* joints are compared with recorded commands. The training did not read the commands
# of these trajectories; the example knows them.

columns = list(task.controller_columns("robot"))
for name, controller in ((name, each.controller) for name, each in trained.items()):
    errors = []
    for frames, commands in recordings[3:13]:
        window = torch.tensor(frames, dtype=torch.float32)[None, :, columns]
        decoded = controller(TensorDict({"state": window}, [1]))["action"][0].detach().numpy()
        errors.append(decoded[5:65] - commands[5:65])
    spread = np.concatenate([commands[5:65] for _, commands in recordings[3:13]]).std()
    print(
        f"{name:8} error of the commands {np.sqrt(np.mean(np.square(errors))):.3f} rad/s (their spread is {spread:.2f})"
    )

# %%
# The control loop
# ----------------
# One file holds weights, statistics and the task. ``act`` takes the measured state and returns the command of this
# tick.

file = Path(tempfile.mkdtemp()) / "arm.safetensors"
trained["koap"].save(file)
print(f"saved {file.name}, {file.stat().st_size / 1e3:.0f} kB")
policy = torchrl_koap.load_policy(file)

paths, reached, clear = [], 0, 0
for trial in range(20):
    arm, agent = Arm(1000 + trial), torchrl_koap.Agent(policy, seed=trial)
    agent.reset()
    path = [arm.joints]
    for _ in range(90):  # in your loop: at 30 Hz until the operator stops it
        arm.command(agent.act(arm.read()))
        path.append(arm.joints)
    paths.append(np.array(path))
    reached += np.linalg.norm(arm.joints - arm.goal) < 0.05
    clear += np.linalg.norm(paths[-1] - POLE, axis=1).min() > CLEARANCE
sides = [int(path[np.abs(path[:, 0]).argmin(), 1] > 0) for path in paths]
print(f"20 trials: {reached} reached the goal within 0.05 rad, {clear} kept clear of the pole")
print(f"{sides.count(0)} passed it on one side, {sides.count(1)} on the other")
latency = agent.latency()
print(f"time per tick: median {latency['p50']:.1f} ms, longest {latency['max']:.1f} ms; a tick of 30 Hz is 33 ms")

# %%
figure = Figure(figsize=(8, 3.2), layout="constrained")
for axes, (title, shown) in zip(
    figure.subplots(1, 2, sharex=True, sharey=True),
    {"recorded (3 with commands, orange)": [frames[:, :2] for frames in states], "control loop": paths}.items(),
    strict=True,
):
    for index, path in enumerate(shown):
        labelled = len(shown) == len(states) and actions[index] is not None
        axes.plot(*path.T, color="#d9730d" if labelled else "#1f6feb", linewidth=1.8 if labelled else 0.7)
    angle = np.linspace(0, 2 * np.pi)
    axes.fill(CLEARANCE * np.cos(angle), CLEARANCE * np.sin(angle), color="#8a929e")
    axes.set(title=title, xlabel="joint 1 (rad)", ylabel="joint 2 (rad)", aspect="equal")
figure.savefig("own_robot.png", dpi=90)

# %%
# Conclusion
# ----------
# Three of sixty trajectories had commands. If trials miss, train the planner longer first; the default has six times
# as many updates. An ``AsynchronousAgent`` plans in a thread. From the shell, use ``koap convert``, ``koap train`` and
# ``koap eval``. The time per tick is that of the machine that made this page.
