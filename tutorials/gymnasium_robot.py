# This source code is licensed under the MIT license found in the LICENSE file.
"""
A Gymnasium environment with most actions hidden
================================================

**What you will learn**

* how recordings of any Gymnasium environment become a data set, most of them without actions,
* how a policy trained on them is rolled out in that environment, and what success is there.

Run it with ``python tutorials/gymnasium_robot.py``; it writes ``gymnasium_robot.png``.
"""

# %%
# The environment
# ---------------
# ``PointMaze`` of gymnasium-robotics has a ball in a U-shaped maze, pushed by a force. A policy reads one flat row of
# columns. The wrapper concatenates position, velocity and goal. It repeats every force for four steps (25 Hz).

import tempfile
from pathlib import Path

import gymnasium
import gymnasium_robotics
import numpy as np
from matplotlib.figure import Figure

from torchrl_koap import (
    ControllerConfig,
    EvalConfig,
    PlannerConfig,
    TrainConfig,
    evaluate,
    save_demonstrations,
    train,
)
from torchrl_koap.runs.weights import load_tensors

gymnasium.register_envs(gymnasium_robotics)
NAMES = ("x", "y", "speed_x", "speed_y", "goal_x", "goal_y")


class FlatMaze(gymnasium.Wrapper):
    """From the upper end of the U to the lower one."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (6,), np.float64)

    def __init__(self):
        super().__init__(gymnasium.make("PointMaze_UMaze-v3", continuing_task=False, max_episode_steps=10_000))

    def reset(self, *, seed=None, options=None):
        ends = {"reset_cell": np.array([1, 1]), "goal_cell": np.array([3, 1])}
        seen, info = self.env.reset(seed=seed, options=ends)
        return self.flat(seen), info

    def step(self, action):
        for _ in range(4):
            seen, reward, terminated, truncated, info = self.env.step(action)
            if terminated:
                break
        return self.flat(seen), reward, terminated, truncated, info

    def flat(self, seen):
        return np.concatenate([seen["observation"], seen["desired_goal"]])


gymnasium.register("FlatMaze-v0", entry_point=FlatMaze, max_episode_steps=150)

# %%
# Demonstrations
# --------------
# A scripted expert goes from corner to corner and takes its turns differently in each episode. Forty episodes are
# recorded. Three of them keep their forces.


def demonstrate(env, seed):
    rng = np.random.default_rng(seed)
    corners = [rng.normal((0.9, 0.9), 0.12), rng.normal((0.9, -0.9), 0.12)]
    rows, forces = [env.reset(seed=seed)[0]], []
    while len(forces) < 150:
        place, speed = rows[-1][:2], rows[-1][2:4]
        if corners and np.linalg.norm(corners[0] - place) < 0.35:
            corners.pop(0)
        target = corners[0] if corners else rows[-1][4:]
        wanted = 1.2 * (target - place) / max(np.linalg.norm(target - place), 0.3)
        forces.append(np.clip(0.8 * (wanted - speed) + rng.normal(0, 0.05, 2), -1, 1))
        seen, _, terminated, _, _ = env.step(forces[-1])
        rows.append(seen)
        if terminated:
            break
    return np.array(rows), np.array(forces)


env = FlatMaze()
recordings = [demonstrate(env, seed) for seed in range(40)]
states = [rows for rows, _ in recordings]
actions = [forces if index % 13 == 0 and index < 39 else None for index, (_, forces) in enumerate(recordings)]
steps = [len(rows) - 1 for rows in states]
print(f"{len(states)} demonstrations of {min(steps)} to {max(steps)} steps,")
print(f"{sum(map(len, filter(lambda a: a is not None, actions)))} of {sum(steps)} steps with their action")

# %%
# Training and rollouts
# ---------------------
# The folder holds names, units and what the actions move. From the shell, use ``koap convert``, ``koap train`` and
# ``koap eval RUN --env FlatMaze-v0``.

folder = Path(tempfile.mkdtemp())
data = save_demonstrations(
    folder / "maze",
    states,
    actions,
    control_hz=25,
    state_names=NAMES,
    action_names=("force_x", "force_y"),
    action_units="N",
    robot=NAMES[:4],
)
results = {}
planner = None
for method in ("linear", "koap_untrained", "koap"):
    run = folder / method
    shared = PlannerConfig(source=planner) if planner else PlannerConfig(steps=800)
    options = {"planner": shared, "controller": ControllerConfig(steps=200)}
    train(TrainConfig(dataset=str(data), out=run, method=method, **options))
    planner = planner or run
    results[method] = evaluate(run, EvalConfig(episodes=20, env="FlatMaze-v0", success_key="success"))

print("\nrollouts from the upper end to the lower one, 20 each")
for method, result in results.items():
    rate, low, high = (100 * result["rates"]["success"][name] for name in ("rate", "low", "high"))
    print(
        f"{method:16} {rate:5.1f} % ({low:.0f}-{high:.0f}),"
        f" {np.mean([row['steps'] for row in result['episode']]):.0f} steps"
    )

# %%
figure = Figure(figsize=(8, 3.4), layout="constrained")
for axes, (name, paths) in zip(
    figure.subplots(1, 2, sharex=True, sharey=True),
    {
        "demonstrations": [rows[:, :2] for rows in states],
        "rollouts, koap": list(load_tensors(folder / "koap" / "rollouts.safetensors")[0]["position"].numpy()),
    }.items(),
    strict=True,
):
    for index, path in enumerate(paths):
        labelled = name == "demonstrations" and actions[index] is not None
        axes.plot(*path.T[:2], color="#d9730d" if labelled else "#1f6feb", linewidth=1.8 if labelled else 0.7)
    axes.fill_between((-1.5, 0.5), -0.5, 0.5, color="#8a929e")
    axes.set(title=name, aspect="equal", xlim=(-1.6, 1.6), ylim=(-1.6, 1.6), xlabel="x (m)")
figure.savefig("gymnasium_robot.png", dpi=90)

# %%
# Conclusion
# ----------
# Only the orange paths had actions; the blue ones show the route. Any environment with a flat box of the task's columns
# works. ``--success-key`` names an entry of ``info``.
