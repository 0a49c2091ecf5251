# This source code is licensed under the MIT license found in the LICENSE file.
"""
A task of your own, with an object
==================================

**What you will learn**

* what a task holds: columns, units, goal, modes and a scene,
* what an environment and a scripted expert must provide,
* how to record demonstrations, train, roll out and draw with them.

Run it with ``python tutorials/own_task.py``; it writes ``own_task.png``.
"""

# %%
# The task
# --------
# A robot pushes a puck past a post, on the left or on the right, into a goal. A task describes data and goal without a
# simulator. In your package this is ``my_package/task.py``, for ``koap train --plugin my_package.task``.

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_koap import EvalConfig, LabelConfig, Task, TrainConfig, evaluate, register_task, train
from torchrl_koap.envs.contexts import check_contexts, draw_contexts
from torchrl_koap.envs.experts.demonstrations import record_to_folder
from torchrl_koap.envs.experts.recording import Expert
from torchrl_koap.reports.scenes import draw_scene
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import Action, Body, Defaults, Modes, Scene, Shape

GOAL, GOAL_RADIUS = (0.5, 0.4), 0.05  # m
POST = (0.5, 0.2)
PUCK_RADIUS, ROBOT_RADIUS = 0.03, 0.01
START = ((0.4, 0.6), (0.05, 0.1))  # of the puck: x range, y range (m)
HERE = "own_task"  # import strings need a module; this file is registered as one
sys.modules[HERE] = sys.modules[__name__]


def goal_reached(task, state):
    """Judges states [*B, 4], planned ones too: an environment judges the physics."""
    return (state[..., task.state_slices["puck_xy"]] - state.new_tensor(GOAL)).norm(dim=-1) < GOAL_RADIUS


task = register_task(
    Task(
        name="push_past_a_post",
        observation_parts={"robot_xy": ("x", "y"), "puck_xy": ("puck_x", "puck_y")},
        actions={"x": Action("m", column=0), "y": Action("m", column=1)},
        position="robot_xy",
        max_steps=200,
        control_hz=20.0,
        robot=(0, 1),
        relative_positions=(("robot_xy", "puck_xy"),),
        goal=f"{HERE}:goal_reached",
        modes=Modes((("side", ("left", "right")),), leaves=((0,), (1,)), entropy="all"),
        env=f"{HERE}:PushEnv",
        expert=f"{HERE}:PushExpert",
        scene=Scene(
            shapes=(
                Shape("circle", GOAL, (GOAL_RADIUS, GOAL_RADIUS), "zone", label="goal"),
                Shape("circle", POST, (0.01, 0.01), "obstacle"),
            ),
            bodies=(Body("puck", "puck_xy", starts=(START,), color="blue", half=(PUCK_RADIUS, PUCK_RADIUS)),),
            x=(0.25, 0.75),
            y=(-0.05, 0.5),
        ),
        defaults=Defaults(
            demonstrations=200,
            planner={"steps": 4000, "network": "mlp", "width": 256, "batch_size": 256},
        ),
    )
)
print(f"the planner sees {task.state_names}, the controller {[task.state_names[c] for c in task.robot]}")

# %%
# The environment
# ---------------
# This TorchRL environment has a native batch. It also writes ``success``, ``mode`` and the ``context`` of the episode,
# the start of the puck. Contexts are drawn from the task's start regions or given.


class PushEnv(EnvBase):
    def __init__(self, num_envs=1, num_threads=1, max_steps=200, seed=None, dtype=torch.float32):
        super().__init__(batch_size=[num_envs])
        self.max_steps, self._dtype = max_steps, dtype
        self.robot, self.puck, self.contexts = (
            np.zeros(shape) for shape in ((num_envs, 2), (num_envs, 2), (num_envs, 1, 3))
        )
        self.mode, self.steps = np.full(num_envs, -1), np.zeros(num_envs, dtype=int)
        self.success = np.zeros(num_envs, dtype=bool)
        shape, flag = self.batch_size, {"n": 1, "shape": (num_envs, 1), "dtype": torch.bool}
        self.observation_spec = Composite(
            observation=Unbounded((*shape, 4), dtype=dtype),
            success=Binary(**flag),
            mode=Bounded(-1, 1, (*shape, 1), dtype=torch.int64),
            context=Unbounded((*shape, 1, 3), dtype=dtype),
            shape=shape,
        )
        self.action_spec = Bounded(-0.015, 0.015, (*shape, 2), dtype=dtype)
        self.reward_spec = Bounded(0.0, 1.0, (*shape, 1), dtype=dtype)
        done = Categorical(2, (*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(done=done, terminated=done.clone(), truncated=done.clone(), shape=shape)
        self._set_seed(seed)

    def _set_seed(self, seed):
        self.generator = np.random.default_rng(seed)

    def _reset(self, tensordict=None, *, contexts=None, **kwargs):
        drawn = draw_contexts(task, len(self.puck), self.generator) if contexts is None else contexts
        self.contexts = check_contexts(task, drawn)
        self.robot[:], self.puck[:] = (0.5, 0.0), self.contexts[:, 0, :2]
        self.mode[:], self.steps[:], self.success[:] = -1, 0, False
        return self.leaves()

    def _step(self, tensordict):
        self.robot += tensordict["action"].double().numpy()
        away = self.puck - self.robot
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        self.puck += np.maximum(PUCK_RADIUS + ROBOT_RADIUS - distance, 0) * away / np.maximum(distance, 1e-9)
        passed = (self.puck[:, 1] >= POST[1]) & (self.mode < 0)
        self.mode[passed] = self.puck[passed, 0] >= POST[0]
        self.success |= np.linalg.norm(self.puck - GOAL, axis=1) < GOAL_RADIUS  # stays until the reset
        self.steps += 1
        leaves = self.leaves()
        return leaves.set("reward", leaves["success"].to(self._dtype))

    def leaves(self):
        late = self.steps >= self.max_steps
        flags = {"success": self.success, "terminated": self.success, "truncated": late, "done": self.success | late}
        leaves = {name: torch.tensor(value[:, None]) for name, value in flags.items()}
        leaves["observation"] = torch.tensor(np.concatenate([self.robot, self.puck], 1), dtype=self._dtype)
        leaves["mode"] = torch.tensor(self.mode[:, None].copy())
        leaves["context"] = torch.tensor(self.contexts, dtype=self._dtype)
        return TensorDict(leaves, self.batch_size)


# %%
# The expert
# ----------
# It gets a mode per episode, returns actions and reports its end. Failed episodes are discarded and counted.


class PushExpert(Expert):
    def __init__(self, modes, contexts, seeds):
        wide = [np.random.default_rng(seed).uniform(0.05, 0.09) for seed in seeds]
        self.gates = np.array([(POST[0] + (2 * m - 1) * w, POST[1] + 0.02) for m, w in zip(modes, wide, strict=True)])
        self.passed, self.finished = np.zeros((2, len(modes)), dtype=bool)

    def act(self, observation):
        return np.stack([self.move(row, seen[:2], seen[2:]) for row, seen in enumerate(observation)])

    def move(self, row, robot, puck):
        self.passed[row] |= puck[1] > POST[1]
        target = np.array(GOAL) if self.passed[row] else self.gates[row]
        self.finished[row] |= np.linalg.norm(puck - GOAL) < 0.6 * GOAL_RADIUS
        if self.finished[row]:
            return np.zeros(2)
        ahead = (target - puck) / max(np.linalg.norm(target - puck), 1e-9)
        across, off, reach = np.array([-ahead[1], ahead[0]]), robot - puck, PUCK_RADIUS + ROBOT_RADIUS
        along, aside = off @ ahead, off @ across
        if along < -0.75 * reach and abs(aside) < 0.5 * reach:  # behind the puck: push, and correct sideways
            wanted = ahead - np.clip(80 * aside, -3, 3) * across
        elif along < -0.75 * reach:  # move to a point behind it
            wanted = -1.5 * reach * ahead - off
        elif abs(aside) < 1.5 * reach:  # first move sideways, away from it
            wanted = np.copysign(1.0, aside) * across - 0.2 * ahead
        else:
            wanted = -ahead
        return 0.008 * wanted / np.linalg.norm(wanted)


# %%
# Record, train, roll out
# -----------------------
# Now record demonstrations balanced over modes, train with 5 % of the labels and roll out from new starts.

folder = Path(tempfile.mkdtemp())
print(record_to_folder(folder / "demos", task, task.defaults.demonstrations))
run = folder / "run"
trained = train(TrainConfig(dataset=str(folder / "demos"), out=run, labels=LabelConfig(fraction=0.05)))
labels = trained.results["labels"]
print(f"labels: {labels['labelled_transitions']} of {labels['total_transitions']} transitions")
result = evaluate(run, EvalConfig(episodes=40, rollouts_per_context=2, seed=100))
rate, low, high = (100 * result["rates"]["success"][name] for name in ("rate", "low", "high"))
print(f"success {rate:.1f} % ({low:.0f}-{high:.0f}) of 40 rollouts")
errors = result["action_errors"]["outside_budget"]["unit"][0]  # the data hold all actions: only evaluation reads these
print("action error, mm:", {name: round(1e3 * errors[name], 2) for name in ("controller", "ridge", "mean_action")})
print(f"entropy of the sides {result['pooled_mode_entropy']:.2f}, 1 is an even choice")

# %%
rollouts = load_tensors(run / "rollouts.safetensors")[0]
figure = Figure(figsize=(8, 3.9), layout="constrained")
for axes, key, title in zip(
    figure.subplots(1, 2), ("position", "object_position"), ("robot", "puck: starts and paths"), strict=True
):
    draw_scene(axes, task)
    for path, mode in zip(rollouts[key].reshape(40, -1, 2).numpy(), rollouts["mode"].tolist(), strict=True):
        axes.plot(*path.T, color={0: "#1f6feb", 1: "#d9730d"}.get(mode, "black"), linewidth=0.8)
        axes.plot(*path[0], "o", color="#8a929e", markersize=3)
    axes.set_title(title)
figure.savefig("own_task.png", dpi=90)

# %%
# Conclusion
# ----------
# A simulated task needs three files: task, environment and expert. Recordings without a simulator need none:
# ``save_demonstrations`` writes the task into the data set.
